/// The options of a URL: names and values, in their order, each name once.
#[derive(Debug, Default)]
pub(crate) struct UrlOptions<'a>(Vec<(&'a str, &'a str)>);

impl<'a> UrlOptions<'a> {
    /// Adds an option. Returns `false` if its name is there already.
    #[must_use]
    pub(crate) fn add(&mut self, name: &'a str, value: &'a str) -> bool {
        let is_new = self.get(name).is_none();
        if is_new {
            self.0.push((name, value));
        }
        is_new
    }

    /// The value of the option of this name, not parsed.
    pub(crate) fn get(&self, name: &str) -> Option<&'a str> {
        self.0.iter().find(|(known, _)| *known == name).map(|(_, value)| *value)
    }
}

/// Lists alternatives for a message: `` `a`, `b` or `c` ``.
pub(crate) fn one_of<'a>(names: impl IntoIterator<Item = &'a str>) -> String {
    let names: Vec<String> = names.into_iter().map(|name| format!("`{name}`")).collect();
    match names.split_last() {
        Some((last, others @ [_, ..])) => format!("{} or {last}", others.join(", ")),
        Some((last, [])) => last.clone(),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alternatives_are_listed_with_commas_and_or() {
        for (names, text) in
            [(&["a"][..], "`a`"), (&["a", "b"], "`a` or `b`"), (&["a", "b", "c"], "`a`, `b` or `c`"), (&[], "")]
        {
            assert_eq!(one_of(names.iter().copied()), text);
        }
    }

    #[test]
    fn the_first_value_of_an_option_is_kept() {
        let mut options = UrlOptions::default();
        assert!(options.add("copies", "1") && options.add("quiet", "") && !options.add("copies", "2"));
        assert_eq!((options.get("copies"), options.get("quiet"), options.get("window")), (Some("1"), Some(""), None));
    }
}
