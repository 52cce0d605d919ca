//! Texts of faults that name the known keys, and the one that was probably meant.

use crate::printable::excerpt;

/// The rule that an unknown key breaks: it names the known ones.
pub(super) fn known_keys(key: &str, known: &[&str]) -> String {
    let meant = match closest(key, known) {
        Some(meant) => format!("; did you mean `{meant}`?"),
        None => String::new(),
    };
    match known {
        [] => "the key is unknown: the section has none".to_owned(),
        known => format!("the key is unknown{meant} (known: {})", known.join(" ")),
    }
}

/// The text of a fault that serde has found, for this path of keys.
///
/// Serde names the keys of a section in backquotes: first the unknown one, and then those that are known.
pub(super) fn of_serde(message: &str) -> String {
    if !message.starts_with("unknown field") {
        return excerpt(message).to_string();
    }
    let mut quoted = message.split('`').skip(1).step_by(2);
    let key = quoted.next().unwrap_or_default();
    let known: Vec<&str> = quoted.collect();
    known_keys(key, &known)
}

/// The known text that is close to this one: at most a third of it is different.
pub(super) fn closest<'k>(text: &str, known: &[&'k str]) -> Option<&'k str> {
    let distance = |known: &str| strsim::damerau_levenshtein(&text.to_lowercase(), known);
    let (distance, meant) =
        known.iter().map(|known| (distance(known), *known)).min_by_key(|(distance, _)| *distance)?;
    (distance <= text.chars().count().div_ceil(3).min(3)).then_some(meant)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_that_is_nearly_known_is_suggested() {
        let known = ["url", "user", "password_file", "prefix"];
        for (text, meant) in [
            ("urls", Some("url")),
            ("URL", Some("url")),
            ("usr", Some("user")),
            ("pasword_file", Some("password_file")),
            ("password", None),
            ("x", None),
            ("", None),
        ] {
            assert_eq!(closest(text, &known), meant, "{text}");
        }
        assert_eq!(known_keys("usr", &known[..2]), "the key is unknown; did you mean `user`? (known: url user)");
    }

    #[test]
    fn keys_are_found_in_the_messages_of_serde() {
        let message = "unknown field `usr`, expected one of `url`, `user`";
        assert_eq!(of_serde(message), "the key is unknown; did you mean `user`? (known: url user)");
        assert_eq!(of_serde("unknown field `x`, there are no fields"), "the key is unknown: the section has none");
        assert_eq!(of_serde("invalid type"), "invalid type");
    }
}
