//! `#[derive(Tags)]`: structs whose fields are tags of a PLC.
//!
//! Use it by the feature `derive` of the crate `fatek`, which documents the trait `Tags`.

mod expand;
mod field;

use proc_macro::TokenStream;

/// Implements `fatek::Tags` for a struct with named fields, each with an attribute `#[tag("…")]`.
///
/// Behind the text of the tag can stand `read_only`, `one_scan` and `one_scan = "group"`. The attribute
/// `#[tags(crate = path)]` of the struct names the crate, if it is not `fatek`.
#[proc_macro_derive(Tags, attributes(tag, tags))]
pub fn derive_tags(input: TokenStream) -> TokenStream {
    let input = syn::parse_macro_input!(input as syn::DeriveInput);
    expand::tags(&input).unwrap_or_else(syn::Error::into_compile_error).into()
}
