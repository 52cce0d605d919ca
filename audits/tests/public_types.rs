//! Room for additions: every public enum, constructible struct and trait is either open to
//! additions, or closed for a reason given here.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use syn::{Attribute, Fields, Item, Visibility};

/// Enums that can be matched without a wildcard.
const CLOSED_ENUMS: &[(&str, &str)] = &[
    ("ControlPlc", "command 41 has one bit: it runs or stops"),
    ("DiscreteControl", "command 42 has these four codes"),
    ("Element", "an element has one of the three widths"),
    ("Side", "a line has two ends"),
    ("Value", "a value has one of the three widths"),
    ("Width", "the protocol has values of 1, 16 and 32 bits"),
];

/// Structs that can be constructed and destructured.
const CLOSED_STRUCTS: &[(&str, &str)] = &[
    ("ControlDiscrete", "all that command 42 has"),
    ("Frame", "all that a frame of either framing carries; codecs take frames that were made elsewhere"),
    ("ReadProgramPage", "all that command 4F has"),
    ("WriteProgramPage", "all that command 50 has"),
];

/// Variants that can be matched without `..`.
///
/// Variants of errors are not listed: programs match on their fields, and later releases add
/// variants instead of fields.
const CLOSED_VARIANTS: &[(&str, &str)] = &[
    ("Received::Discarded", "the bytes and the reason; every user takes both"),
    ("Fault::Delay", "tests construct it: a new field would break all of them"),
    ("Fault::AnswerBroadcast", "like `Fault::Delay`"),
    ("Fault::Extended", "like `Fault::Delay`"),
    ("Fault::GarbageBefore", "like `Fault::Delay`"),
    ("Fault::GarbageInside", "like `Fault::Delay`"),
    ("Fault::LeftOver", "like `Fault::Delay`"),
    ("Fault::SecondAnswer", "like `Fault::Delay`"),
    ("Fault::Split", "like `Fault::Delay`"),
    ("Fault::Truncated", "like `Fault::Delay`"),
    ("Timing::After", "like `Fault::Delay`"),
    ("Timing::AfterNextReply", "like `Fault::Delay`"),
    ("Timing::WithNextRequest", "like `Fault::Delay`"),
];

/// Traits that can be implemented elsewhere: a new method without a body would break a program.
const OPEN_TRAITS: &[(&str, &str)] = &[
    ("Execute", "needs `Command`, which is sealed"),
    ("FieldReader", "`fatek decode` implements it to note the fields; a new method must have a body"),
    ("FieldWriter", "like `FieldReader`, whose counterpart it is"),
    ("FromTag", "own types are read from tags"),
    ("FromTags", "own types are read from several tags"),
    ("IntoAssignment", "own types are assignments"),
    ("IntoAssignments", "own lists of assignments are written"),
    ("IntoTag", "own types name a tag"),
    ("IntoTagValues", "own types are written to tags"),
    ("TagSet", "own types name several tags"),
    ("Tags", "structs of tags implement it, mostly by `#[derive(Tags)]`"),
];

#[derive(Default)]
struct Scan {
    enums: BTreeSet<String>,
    structs: BTreeSet<String>,
    variants: BTreeSet<String>,
    traits: BTreeSet<String>,
    /// Number of public enums and structs.
    seen: usize,
}

impl Scan {
    fn scan(&mut self, items: &[Item], path: &Path) {
        for item in items {
            match item {
                Item::Enum(item) if is_public(&item.vis) => {
                    self.seen += 1;
                    if !is_open(&item.attrs) {
                        self.enums.insert(item.ident.to_string());
                    }
                    let is_error = derives_error(&item.attrs);
                    for variant in &item.variants {
                        if matches!(variant.fields, Fields::Named(_)) && !is_open(&variant.attrs) && !is_error {
                            self.variants.insert(format!("{}::{}", item.ident, variant.ident));
                        }
                    }
                }
                Item::Struct(item) if is_public(&item.vis) => {
                    self.seen += 1;
                    let literal =
                        matches!(&item.fields, Fields::Named(fields) if fields.named.iter().all(|f| is_public(&f.vis)));
                    if literal && !is_open(&item.attrs) {
                        self.structs.insert(item.ident.to_string());
                    }
                }
                Item::Trait(item) if is_public(&item.vis) => {
                    let bounds = item.supertraits.iter().filter_map(|bound| match bound {
                        syn::TypeParamBound::Trait(bound) => bound.path.segments.last().map(|s| s.ident.to_string()),
                        _ => None,
                    });
                    if item.ident != "Sealed" && !bounds.into_iter().any(|name| name == "Sealed") {
                        self.traits.insert(item.ident.to_string());
                    }
                }
                Item::Mod(item) => self.scan(item.content.as_ref().map_or(&[], |(_, items)| items), path),
                // The tables define enums by macros, whose content is tokens here.
                Item::Macro(item) => self.scan_tokens(&item.mac.tokens.to_string(), path),
                _ => {}
            }
        }
    }

    fn scan_tokens(&mut self, tokens: &str, path: &Path) {
        let mut parts = tokens.split("pub enum");
        let mut before = parts.next();
        for part in parts {
            self.seen += 1;
            let open = before.is_some_and(|text| text.contains("non_exhaustive"));
            assert!(open, "an enum made by a macro in {path:?} is not #[non_exhaustive]");
            before = Some(part);
        }
    }
}

fn is_public(visibility: &Visibility) -> bool {
    matches!(visibility, Visibility::Public(_))
}

fn is_open(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| attribute.path().is_ident("non_exhaustive"))
}

fn derives_error(attributes: &[Attribute]) -> bool {
    attributes.iter().filter(|a| a.path().is_ident("derive")).any(|attribute| match &attribute.meta {
        syn::Meta::List(list) => list.tokens.to_string().replace(' ', "").split(',').any(|d| d == "thiserror::Error"),
        _ => false,
    })
}

fn sources(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("the sources are here") {
        let path = entry.expect("it can be listed").path();
        if path.is_dir() && path.file_name() != Some("bin".as_ref()) {
            sources(&path, files);
        } else if path.extension() == Some("rs".as_ref()) {
            files.push(path);
        }
    }
}

fn found() -> Scan {
    let mut files = Vec::new();
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../src"), &mut files);
    let mut found = Scan::default();
    for path in files {
        let text = std::fs::read_to_string(&path).expect("it can be read");
        found.scan(&syn::parse_file(&text).expect("it is Rust").items, &path);
    }
    found
}

fn names(list: &[(&str, &str)]) -> BTreeSet<String> {
    list.iter().map(|(name, _)| (*name).to_owned()).collect()
}

#[test]
fn types_are_exhaustive_only_for_a_stated_reason() {
    let found = found();
    // A scan that finds no types would pass.
    assert!(found.seen > 100, "only {} public types were found", found.seen);
    let hint = "add #[non_exhaustive], or give the reason in this file";
    assert_eq!(found.enums, names(CLOSED_ENUMS), "public enums: {hint}");
    assert_eq!(found.structs, names(CLOSED_STRUCTS), "public structs with public fields: {hint}");
    assert_eq!(found.variants, names(CLOSED_VARIANTS), "fields of variants: {hint}");
}

#[test]
fn public_traits_are_sealed() {
    assert_eq!(found().traits, names(OPEN_TRAITS), "seal it, or give the reason in this file");
}

#[test]
fn the_scan_finds_types_and_traits_left_closed() {
    let text = "
        pub enum Shut { A { field: u8 } }
        #[non_exhaustive] pub enum Open { #[non_exhaustive] B { field: u8 }, C(u8) }
        #[derive(Debug, thiserror::Error)] #[non_exhaustive] pub enum Problem { D { field: u8 } }
        pub struct Literal { pub a: u8 }
        pub struct Opaque { pub a: u8, b: u8 }
        enum Private { E { field: u8 } }
        mod inner { pub trait Anyone {} pub trait Few: sealed::Sealed {} }
    ";
    let mut found = Scan::default();
    found.scan(&syn::parse_file(text).expect("it is Rust").items, Path::new("here"));
    let set = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<BTreeSet<_>>();
    assert_eq!(found.enums, set(&["Shut"]));
    assert_eq!(found.variants, set(&["Shut::A"]));
    assert_eq!(found.structs, set(&["Literal"]));
    assert_eq!(found.traits, set(&["Anyone"]));
}

#[test]
#[should_panic(expected = "made by a macro")]
fn the_scan_looks_into_macros() {
    Scan::default().scan_tokens("# [derive (Debug)] pub enum Made { }", Path::new("here"));
}
