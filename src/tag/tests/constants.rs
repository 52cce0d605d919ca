//! Tags in constants are those of texts.

use super::*;

/// `Tag::parse` against `FromStr`: equal tags and equal rules.
fn is_the_same(text: &str) -> bool {
    match (Tag::parse(text), text.parse::<Tag>()) {
        (Ok(tag), Ok(parsed)) => {
            // The decimals of a scale are not compared by `==`.
            tag == parsed && format!("{tag:?}") == format!("{parsed:?}")
        }
        (Err(error), Err(parsed)) => error == *parsed.reason() || error == TagError::Scale(ScaleError::NotConst),
        (Err(error), Ok(_)) => error == TagError::Scale(ScaleError::NotConst),
        (Ok(_), Err(_)) => false,
    }
}

#[test]
fn numbers_of_constants_are_those_of_texts() {
    for (text, is_const) in [
        ("R5:i16*0.1-40", true),
        ("R5:i16*999999999999999", true),
        ("R5:i16*1000000000000000", false),
        ("R5:i16*0.100000000000000", true),
        ("R5:i16*1e-22", true),
        ("R5:i16*1e-23", false),
        ("R5:i16*1e22", true),
        ("R5:i16*10e22", false),
        ("R5:i16*1.5e23", true),
        ("R5:i16*-2.5E+3+1e2", true),
        ("R5:i16-0", true),
        ("R5:i16*.5", true),
        ("R5:i16*5.", true),
        ("R5:i16*0.10-040.00", true),
        ("R5:i16*1e99999999999", false),
    ] {
        assert!(is_the_same(text), "{text}: {:?}, {:?}", Tag::parse(text), text.parse::<Tag>());
        assert_eq!(Tag::parse(text) != Err(TagError::Scale(ScaleError::NotConst)), is_const, "{text}");
    }
}

#[test]
fn the_rules_of_constants_name_the_fault() {
    for (text, rule) in [
        ("Q5", "no element has these letters"),
        ("R", "the letters of an element are followed by decimal digits"),
        ("R99999", "the address is past the last one"),
        ("WM4", "a multiple of 8"),
        ("RC200", "DRC200 to DRC255 are counters of 32 bits"),
        ("R5:f33", "the type is unknown"),
        ("M5:f32", "elements of this width do not have this type"),
        ("R5.16", "does not have this bit"),
        ("R0-D9", "a range has elements of one symbol"),
        ("R9-R0", "the range goes backwards"),
        ("R0-R8:f32", "not a whole number of values"),
        ("R0-R64:text", "a text has at most 64 registers"),
        ("R0:u16*x", "a scale is *GAIN"),
        ("R0:u16*0", "the numbers of its scale are out of range"),
        ("R0:hex*2", "this type takes neither gain nor offset"),
        ("R65535:f32", "the elements reach past the last address"),
    ] {
        let error = Tag::parse(text).unwrap_err();
        assert!(error.rule().contains(rule), "{text}: {}", error.rule());
    }
}

/// The check of the compiler against that of a call, for each type of a tag and of Rust.
#[test]
fn the_compiler_accepts_the_types_that_a_call_accepts() {
    let tags = TagType::ALL.iter().flat_map(|&tag_type| {
        let firsts = [element!("M0"), element!("R0"), element!("DR0")];
        firsts.into_iter().flat_map(move |first| [1, 3].map(|count| Tag::new(first, tag_type, count)))
    });
    let mut tags: Vec<Tag> = tags.filter_map(Result::ok).collect();
    tags.extend(["R0:u16*0.5", "R0:f32+1", "R5.3", "R5.0-R5.2", "R0-R9:text"].map(tag));
    let mut accepted = 0;
    for tag in &tags {
        macro_rules! compare {
            ($($name:ident)*) => {
                $(
                    let fits = [
                        <$name as FromTag>::fits(tag),
                        <[$name; 3] as FromTag>::fits(tag),
                        <Vec<$name> as FromTag>::fits(tag),
                    ];
                    let checked = [Some(1), Some(3), None].map(|count| fits_type(tag, stringify!($name), count));
                    assert_eq!(checked, fits, "{tag} as {}", stringify!($name));
                    accepted += fits.iter().filter(|&&fits| fits).count();
                )*
            };
        }
        compare!(bool u16 i16 u32 i32 u64 i64 f32 f64 String);
    }
    assert!(accepted > 100 && !fits_type(&tags[0], "Bar", None), "{accepted}");
}

proptest! {
    #[test]
    fn any_text_is_the_same_tag_in_a_constant(
        text in prop_oneof![
            "\\PC{0,16}",
            "[RDWMrx]{1,3}[0-9]{1,5}(\\.[0-9]{0,2})?(-[RDM]{0,3}[0-9]{0,5}(\\.[0-9]{0,2})?)?(:([a-z0-9]{0,4}(-hi)?|[uif](16|32)[-*+.0-9eE]{0,12}))?",
            "R5:u16\\*[0-9]{0,8}\\.?[0-9]{0,9}(e-?[0-9]{1,2})?([-+][0-9]{0,9}\\.?[0-9]{0,9}(e[-+]?[0-9]{1,2})?)?",
        ]
    ) {
        prop_assert!(is_the_same(&text), "{}: {:?}, {:?}", text, Tag::parse(&text), text.parse::<Tag>());
    }

    #[test]
    fn any_tag_is_the_same_in_a_constant(tag in tags()) {
        prop_assert!(is_the_same(&tag.to_string()));
    }
}
