//! `#[derive(Parameters)]`: settings with defaults, units and ranges, which are a variable as well;
//! and `#[derive(ParameterType)]` for those that take one of several names.

use crate::attributes::{Derive, TypeAttributes, for_each_key, parse_text, unknown};
use crate::contract;
use crate::structure::option;
use proc_macro2::TokenStream;
use quote::{ToTokens, quote};
use syn::ext::IdentExt;
use syn::{Data, DeriveInput, Error, Expr, ExprLit, Fields, Lit, LitStr, Result, parse_quote};

const KEYS: &[&str] = &["default", "range", "unit"];

/// What `#[parameter(..)]` says about a field.
#[derive(Default)]
struct ParameterAttributes {
    default: Option<Expr>,
    range: Option<Expr>,
    unit: Option<LitStr>,
}

impl ParameterAttributes {
    fn parse(attributes: &[syn::Attribute]) -> Result<Self> {
        let mut parsed = ParameterAttributes::default();
        for_each_key("parameter", attributes, |meta, key| {
            match key {
                "default" => parsed.default = Some(meta.value()?.parse()?),
                "range" => parsed.range = Some(meta.value()?.parse()?),
                "unit" => parsed.unit = Some(parse_text(&meta, "unit")?),
                other => return Err(unknown(&meta, other, KEYS)),
            }
            Ok(())
        })?;
        Ok(parsed)
    }
}

pub(crate) fn derive(input: &DeriveInput) -> Result<TokenStream> {
    let attributes = TypeAttributes::parse(&input.attrs, Derive::Variable)?;
    let facade = &attributes.facade;
    let wrong = |what| Err(Error::new(input.ident.span(), what));
    if !input.generics.params.is_empty() {
        return wrong("parameters cannot be generic: write one struct for each component");
    }
    let Data::Struct(data) = &input.data else {
        return wrong("parameters are a struct, with a field for each parameter");
    };
    let Fields::Named(fields) = &data.fields else {
        return wrong("parameters have names: write a struct with named fields");
    };
    let mut variable = input.clone();
    let (mut defaults, mut descriptions) = (Vec::new(), Vec::new());
    let (mut arms, mut values, mut checks) = (Vec::new(), Vec::new(), Vec::new());
    for (at, field) in fields.named.iter().enumerate() {
        let ParameterAttributes { default, range, unit } =
            ParameterAttributes::parse(&field.attrs)?;
        let (ident, of) = (&field.ident, &field.ty);
        let name = ident.as_ref().map(|ident| ident.unraw().to_string()).unwrap_or_default();
        if let Data::Struct(data) = &mut variable.data
            && let Some(field) = data.fields.iter_mut().nth(at)
        {
            field.attrs.retain(|attribute| !attribute.path().is_ident("parameter"));
            if let Some(unit) = &unit {
                field.attrs.push(parse_quote!(#[contract(unit = #unit)]));
            }
        }
        defaults.push(match default {
            None => quote!(#ident: <#of as ::std::default::Default>::default()),
            Some(text @ Expr::Lit(ExprLit { lit: Lit::Str(_), .. })) => {
                quote!(#ident: ::std::convert::From::from(#text))
            }
            Some(value) => quote!(#ident: #value),
        });
        let unit = option(unit.map(|unit| quote!(#unit)));
        let written = range.as_ref().map(|range| {
            let text = range.to_token_stream().to_string().replace(' ', "");
            quote!(#text)
        });
        let written = option(written);
        descriptions.push(quote! {
            #facade::core::parameters::ParameterField {
                name: #name,
                takes: <#of as #facade::core::parameters::ParameterType>::expected,
                unit: #unit,
                range: #written,
            }
        });
        arms.push(quote! {
            #name => {
                self.#ident = #facade::core::parameters::read(&Self::FIELDS[#at], value)?;
                ::std::result::Result::Ok(())
            }
        });
        values.push(quote! {
            #name => ::std::option::Option::Some(
                #facade::core::parameters::ParameterType::value(&self.#ident),
            ),
        });
        checks.extend(range.map(|range| {
            quote! {
                #facade::core::parameters::check_range(&Self::FIELDS[#at], &self.#ident, #range)?;
            }
        }));
    }
    let variable = contract::derive(&variable, Derive::Variable)?;
    let ident = &input.ident;
    let error = quote!(#facade::core::parameters::ParameterError);
    Ok(quote! {
        #variable

        #[automatically_derived]
        impl ::std::default::Default for #ident {
            fn default() -> Self {
                Self { #(#defaults),* }
            }
        }

        #[automatically_derived]
        impl #facade::core::parameters::Parameters for #ident {
            const FIELDS: &'static [#facade::core::parameters::ParameterField] =
                &[#(#descriptions),*];

            fn set(
                &mut self,
                key: &str,
                value: &#facade::core::parameters::ParameterValue,
            ) -> ::std::result::Result<(), #error> {
                match key {
                    #(#arms)*
                    _ => ::std::result::Result::Err(
                        #facade::core::parameters::unknown(key, Self::FIELDS),
                    ),
                }
            }

            fn check(&self) -> ::std::result::Result<(), #error> {
                #(#checks)*
                ::std::result::Result::Ok(())
            }

            fn value(
                &self,
                key: &str,
            ) -> ::std::option::Option<#facade::core::parameters::ParameterValue> {
                match key {
                    #(#values)*
                    _ => ::std::option::Option::None,
                }
            }
        }
    })
}

/// An enum of which a parameter takes one variant, by its name.
pub(crate) fn derive_type(input: &DeriveInput) -> Result<TokenStream> {
    let attributes = TypeAttributes::parse(&input.attrs, Derive::Structure)?;
    let facade = &attributes.facade;
    let wrong = |span, what| Err(Error::new(span, what));
    let Data::Enum(data) = &input.data else {
        return wrong(input.ident.span(), "the type of a parameter is an enum, without fields");
    };
    if !input.generics.params.is_empty() {
        return wrong(input.ident.span(), "the type of a parameter cannot be generic");
    }
    if let Some(variant) = data.variants.iter().find(|it| !matches!(it.fields, Fields::Unit)) {
        return wrong(variant.ident.span(), "a parameter takes variants without fields");
    }
    let variants: Vec<_> = data.variants.iter().map(|variant| &variant.ident).collect();
    let names: Vec<_> = variants.iter().map(|ident| ident.unraw().to_string()).collect();
    let expected = format!("one of `{}`", names.join("`, `"));
    let structure = crate::structure::expand(input, &attributes)?;
    let ident = &input.ident;
    let value = quote!(#facade::core::parameters::ParameterValue);
    Ok(quote! {
        #structure

        #[automatically_derived]
        impl #facade::core::parameters::ParameterType for #ident {
            type Element = Self;

            fn expected() -> ::std::string::String {
                ::std::convert::From::from(#expected)
            }

            fn of(value: &#value) -> ::std::option::Option<Self> {
                let (#value::Text(name) | #value::Written(name)) = value else {
                    return ::std::option::Option::None;
                };
                match &**name {
                    #(#names => ::std::option::Option::Some(Self::#variants),)*
                    _ => ::std::option::Option::None,
                }
            }

            fn value(&self) -> #value {
                #value::Text(::std::convert::From::from(match self {
                    #(Self::#variants => #names,)*
                }))
            }

            fn elements(&self) -> &[Self] {
                ::std::slice::from_ref(self)
            }
        }
    })
}
