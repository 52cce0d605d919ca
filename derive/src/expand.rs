//! The implementation of `Tags`.

use proc_macro2::TokenStream;
use quote::{format_ident, quote, quote_spanned};
use syn::spanned::Spanned as _;
use syn::{Data, DeriveInput, Error, Fields, Ident, Path, Result};

use crate::field::{Count, Field};

pub(crate) fn tags(input: &DeriveInput) -> Result<TokenStream> {
    let Data::Struct(data) = &input.data else {
        return Err(Error::new(input.ident.span(), "Tags can be derived for a struct only"));
    };
    let Fields::Named(named) = &data.fields else {
        return Err(Error::new(input.ident.span(), "the fields of a struct of tags have names"));
    };
    if !input.generics.params.is_empty() {
        return Err(Error::new(input.generics.span(), "a struct of tags has no generic parameters"));
    }
    // All faults at once.
    let mut faults: Option<Error> = None;
    let mut fields = Vec::new();
    for field in &named.named {
        match (Field::parse(field), &mut faults) {
            (Ok(field), _) => fields.push(field),
            (Err(error), Some(all)) => all.combine(error),
            (Err(error), None) => faults = Some(error),
        }
    }
    match faults {
        Some(faults) => Err(faults),
        None => Ok(implementation(input, &crate_path(input)?, &fields)),
    }
}

/// The path of the crate `fatek`.
fn crate_path(input: &DeriveInput) -> Result<Path> {
    let mut path: Path = syn::parse_quote!(::fatek);
    for attribute in input.attrs.iter().filter(|attribute| attribute.path().is_ident("tags")) {
        attribute.parse_nested_meta(|meta| {
            if meta.path.is_ident("crate") {
                path = meta.value()?.parse()?;
                Ok(())
            } else {
                Err(meta.error("the only option of a struct of tags is `crate`"))
            }
        })?;
    }
    Ok(path)
}

fn implementation(input: &DeriveInput, fatek: &Path, fields: &[Field<'_>]) -> TokenStream {
    let ident = &input.ident;
    let numbers = 0..fields.len();
    // A name that hides no constant of the user in the length of an array.
    let tag = |(field, n): (&Field<'_>, usize)| format_ident!("__FATEK_TAG_{n}", span = field.tag.span());
    let tags: Vec<_> = fields.iter().zip(numbers.clone()).map(tag).collect();
    let tag_constants = fields.iter().zip(&tags).map(|(field, tag)| tag_constant(fatek, field, tag));
    let constants = fields.iter().zip(&tags).map(|(field, tag)| field_constant(fatek, field, tag));
    let type_checks = fields.iter().zip(&tags).map(|(field, tag)| type_check(fatek, field, tag));
    // The struct may have a constant `FIELDS` of its own. Only the type has the span of the type: in a
    // struct of a macro, `self` and `values` would be those of the macro.
    let of = |n: usize| quote!(<Self as #fatek::tag::Tags>::FIELDS[#n]);
    let checks = fields.iter().zip(numbers.clone()).map(|(field, n)| {
        let (of, ty) = (of(n), field.ty);
        quote! { #of.check::<#ty>()?; }
    });
    let values = fields.iter().zip(numbers.clone()).map(|(field, n)| {
        let (of, name, ty) = (of(n), field.name, field.ty);
        quote! { #name: #of.value::<#ty>(values.get(#n))?, }
    });
    let written = fields.iter().zip(numbers).filter(|(field, _)| !field.read_only).map(|(field, n)| {
        let (of, name, ty) = (of(n), field.name, field.ty);
        quote! { #of.assignment::<#ty>(::core::clone::Clone::clone(&self.#name))?, }
    });
    quote! {
        // Constants outside of functions are evaluated by `cargo check`.
        const _: () = {
        #(#tag_constants)*
        #(#type_checks)*

        #[automatically_derived]
        impl #fatek::tag::Tags for #ident {
            const FIELDS: &'static [#fatek::tag::Field] = &[#(#constants,)*];

            fn check() -> ::core::result::Result<(), #fatek::tag::TagAccessError> {
                #(#checks)*
                ::core::result::Result::Ok(())
            }

            fn from_values(
                values: &[::std::vec::Vec<#fatek::tag::TagValue>],
            ) -> ::core::result::Result<Self, #fatek::tag::TagAccessError> {
                ::core::result::Result::Ok(Self { #(#values)* })
            }

            fn assignments(
                &self,
            ) -> ::core::result::Result<::std::vec::Vec<#fatek::tag::Assignment>, #fatek::tag::TagAccessError> {
                ::core::result::Result::Ok(::std::vec![#(#written)*])
            }
        }
        };
    }
}

/// The constant of the tag of a field, which the compiler checks.
fn tag_constant(fatek: &Path, field: &Field<'_>, name: &Ident) -> TokenStream {
    let text = &field.tag;
    // Written out, since an error in `tag!` would be shown at the attribute of the struct.
    quote_spanned! { text.span() =>
        const #name: #fatek::tag::Tag = match #fatek::tag::Tag::parse(#text) {
            ::core::result::Result::Ok(tag) => tag,
            ::core::result::Result::Err(error) => ::core::panic!("{}", error.rule()),
        };
    }
}

/// The `Field` of a field.
fn field_constant(fatek: &Path, field: &Field<'_>, tag: &Ident) -> TokenStream {
    let (name, read_only) = (field.text(), field.read_only);
    let one_scan = field.one_scan.as_ref().map(|group| quote!(.with_one_scan(#group)));
    quote! {
        #fatek::tag::Field::new(#name, #tag).with_read_only(#read_only) #one_scan
    }
}

/// The checks of a field that the compiler makes.
fn type_check(fatek: &Path, field: &Field<'_>, tag: &Ident) -> TokenStream {
    let (name, text) = (field.text(), field.tag.value());
    let bits = (!field.read_only).then(|| {
        let rule = format!(
            "{name}: a bit of a register is not written by itself; make the field read_only, and write it by modify_bits"
        );
        quote_spanned! { tag.span() =>
            const _: () = ::core::assert!(!#tag.is_bits_of_register(), "{}", #rule);
        }
    });
    let fits = field.known_type().map(|known| {
        let (ty, type_name) = (field.ty, &known.name);
        let count = match known.count {
            Count::One => quote!(::core::option::Option::Some(1)),
            Count::Any => quote!(::core::option::Option::None),
            Count::Array(len) => quote!(::core::option::Option::Some(#len)),
        };
        let rule = format!("{name}: the values of {text} do not fit `{}`", quote!(#ty));
        let written = (!field.read_only).then(|| {
            let rule = format!(
                "{name}: {text} takes integers, and `{}` holds fractions; make the field read_only, or its type an integer",
                quote!(#ty)
            );
            quote_spanned! { ty.span() =>
                const _: () = ::core::assert!(#fatek::tag::takes_type(&#tag, #type_name), "{}", #rule);
            }
        });
        quote_spanned! { ty.span() =>
            const _: () = ::core::assert!(#fatek::tag::fits_type(&#tag, #type_name, #count), "{}", #rule);
            #written
        }
    });
    quote!(#bits #fits)
}
