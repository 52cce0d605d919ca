//! Texts of faults that name the known keys, and the one that was probably meant.

use crate::printable::excerpt;

/// The rule that an unknown key breaks: it names the known ones.
pub(super) fn known_keys(key: &str, known: &[&str]) -> String {
    match known {
        [] => "the key is unknown: the section has none".to_owned(),
        known => format!("the key is unknown{} (known: {})", meant(key, known), known.join(" ")),
    }
}

/// A question for the text that was probably meant, if there is one.
pub(super) fn meant(text: &str, known: &[&str]) -> String {
    match closest(text, known) {
        Some(meant) => format!("; did you mean `{}`?", excerpt(meant)),
        None => String::new(),
    }
}

/// The rule of a fault that serde has found.
///
/// Serde names the keys of a section in backquotes: first the unknown one, and then those that are known. Of a
/// value of another kind it names that kind and the value, which is left out: it can be a secret.
pub(super) fn of_serde(message: &str) -> String {
    if message.starts_with("unknown field") {
        let mut quoted = message.split('`').skip(1).step_by(2);
        let key = quoted.next().unwrap_or_default();
        let known: Vec<&str> = quoted.collect();
        return known_keys(key, &known);
    }
    let Some((found, expected)) = message.strip_prefix("invalid ").and_then(|rest| rest.rsplit_once(", expected "))
    else {
        return excerpt(message).to_string();
    };
    let expected = match expected {
        "a string" | "path string" => "a text",
        "a boolean" => "true or false",
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number",
        other => other,
    };
    let kinds = [
        ("type: string", "a text"),
        ("type: integer", "a number"),
        ("type: floating point", "a number with decimals"),
        ("type: boolean", "true or false"),
        ("type: sequence", "a list"),
        ("type: map", "a table"),
    ];
    match kinds.iter().find(|(kind, _)| found.starts_with(kind)) {
        Some((_, kind)) => format!("{expected} is expected, and this is {kind}"),
        None => format!("{expected} is expected"),
    }
}

/// The known text that is close to this one: at most a third of it is different.
fn closest<'k>(text: &str, known: &[&'k str]) -> Option<&'k str> {
    let distance = |known: &str| strsim::damerau_levenshtein(&text.to_lowercase(), &known.to_lowercase());
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
        assert_eq!(of_serde("a size is a number"), "a size is a number");
    }

    #[test]
    fn values_of_another_kind_are_named_without_the_value() {
        for (message, rule) in [
            ("invalid type: integer `5`, expected a string", "a text is expected, and this is a number"),
            (
                "invalid type: string \"hunter2, expected x\", expected a boolean",
                "true or false is expected, and this is a text",
            ),
            ("invalid type: sequence, expected a table", "a table is expected, and this is a list"),
            ("invalid value: integer `-1`, expected u32", "a whole number is expected"),
        ] {
            assert_eq!(of_serde(message), rule);
        }
    }
}
