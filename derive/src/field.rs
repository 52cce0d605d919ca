//! A field of the struct: its attribute and its type.

use quote::ToTokens as _;
use syn::ext::IdentExt as _;
use syn::spanned::Spanned as _;
use syn::{Error, Expr, Ident, LitStr, Result, Token, Type};

/// A field with its tag.
pub(crate) struct Field<'i> {
    pub(crate) name: &'i Ident,
    pub(crate) ty: &'i Type,
    pub(crate) tag: LitStr,
    pub(crate) one_scan: Option<LitStr>,
    pub(crate) read_only: bool,
}

/// A type whose values are known to the compiler.
pub(crate) struct KnownType<'i> {
    /// The name of a number, `bool` or `String`.
    pub(crate) name: String,
    pub(crate) count: Count<'i>,
}

/// The number of items.
pub(crate) enum Count<'i> {
    One,
    /// Of a `Vec`.
    Any,
    /// Of an array.
    Array(&'i Expr),
}

impl<'i> Field<'i> {
    /// Its name as a text: `type` for `r#type`.
    pub(crate) fn text(&self) -> String {
        self.name.unraw().to_string()
    }

    pub(crate) fn parse(field: &'i syn::Field) -> Result<Self> {
        let Some(name) = &field.ident else {
            return Err(Error::new(field.span(), "the fields of a struct of tags have names"));
        };
        let mut attributes = field.attrs.iter().filter(|attribute| attribute.path().is_ident("tag"));
        let Some(attribute) = attributes.next() else {
            let error = format!("the field `{name}` has no tag: write #[tag(\"R100:f32\")] or the like before it");
            return Err(Error::new(field.span(), error));
        };
        if let Some(second) = attributes.next() {
            return Err(Error::new(second.span(), format!("the field `{name}` has two tags")));
        }
        let parser = |input: syn::parse::ParseStream<'_>| {
            let tag: LitStr = input.parse().map_err(|error| {
                Error::new(error.span(), "the text of a tag is expected first, such as \"R100:f32\"")
            })?;
            let mut parsed = Self { name, ty: &field.ty, tag, one_scan: None, read_only: false };
            while !input.is_empty() {
                input.parse::<Token![,]>()?;
                if !input.is_empty() {
                    parsed.option(input)?;
                }
            }
            Ok(parsed)
        };
        attribute.parse_args_with(parser)
    }

    /// Parses one option behind the text.
    fn option(&mut self, input: syn::parse::ParseStream<'_>) -> Result<()> {
        let option: Ident = input.parse()?;
        let is_second = match option.to_string().as_str() {
            "read_only" => std::mem::replace(&mut self.read_only, true),
            "one_scan" => {
                let group =
                    if input.parse::<Option<Token![=]>>()?.is_some() { Some(input.parse::<LitStr>()?) } else { None };
                if let Some(empty) = group.as_ref().filter(|group| group.value().is_empty()) {
                    return Err(Error::new(empty.span(), "the name of a group is empty: write `one_scan` alone"));
                }
                self.one_scan.replace(group.unwrap_or_else(|| LitStr::new("", option.span()))).is_some()
            }
            other => {
                let error = format!("`{other}` is not an option of a tag (known: one_scan read_only)");
                return Err(Error::new(option.span(), error));
            }
        };
        if is_second {
            return Err(Error::new(option.span(), format!("the field `{}` has `{option}` twice", self.name)));
        }
        Ok(())
    }

    /// Its type, if the compiler knows the values of it; own types are checked at run time.
    pub(crate) fn known_type(&self) -> Option<KnownType<'i>> {
        let ty = plain(self.ty);
        if let Some(name) = scalar(ty) {
            return Some(KnownType { name, count: Count::One });
        }
        match ty {
            // A constant outside of the struct does not know `Self`.
            Type::Array(array) if array.len.to_token_stream().to_string().contains("Self") => None,
            Type::Array(array) => Some(KnownType { name: scalar(&array.elem)?, count: Count::Array(&array.len) }),
            Type::Path(path) if path.path.segments.len() == 1 => {
                let segment = path.path.segments.last().filter(|segment| segment.ident == "Vec")?;
                let syn::PathArguments::AngleBracketed(arguments) = &segment.arguments else { return None };
                match arguments.args.first() {
                    Some(syn::GenericArgument::Type(item)) if arguments.args.len() == 1 => {
                        Some(KnownType { name: scalar(item)?, count: Count::Any })
                    }
                    _ => None,
                }
            }
            _ => None,
        }
    }
}

/// The name of a number, `bool` or `String`.
fn scalar(ty: &Type) -> Option<String> {
    const KNOWN: [&str; 10] = ["bool", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64", "String"];
    let Type::Path(path) = plain(ty) else { return None };
    let name = path.path.get_ident()?.to_string();
    KNOWN.contains(&name.as_str()).then_some(name)
}

/// A type without the groups and parentheses that macros put around it.
fn plain(ty: &Type) -> &Type {
    match ty {
        Type::Group(group) => plain(&group.elem),
        Type::Paren(paren) => plain(&paren.elem),
        ty => ty,
    }
}
