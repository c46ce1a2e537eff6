//! `#[derive(Structure)]`: a type's structure as data, and its encoding.

use crate::attributes::{FieldAttributes, TypeAttributes, refuse_on_variant};
use crate::foreign::refuse_foreign;
use proc_macro2::TokenStream;
use quote::{ToTokens, quote, quote_spanned};
use syn::ext::IdentExt;
use syn::spanned::Spanned;
use syn::{
    Attribute, Data, DeriveInput, Error, Field, Fields, GenericArgument, GenericParam, Generics,
    LitStr, PathArguments, Result, Type, Visibility, parse_quote, parse_quote_spanned,
};

/// The part that all derives have in common.
pub(crate) fn expand(input: &DeriveInput, attributes: &TypeAttributes) -> Result<TokenStream> {
    refuse_foreign(input)?;
    let layout = layout(input, attributes)?;
    let encoding = encoding(input, attributes);
    Ok(quote! {
        const _: () = {
            #layout
            #encoding
        };
    })
}

/// The generics with everything that stands in for a type made [`Described`].
pub(crate) fn described_generics(input: &DeriveInput, attributes: &TypeAttributes) -> Generics {
    let facade = &attributes.facade;
    let mut generics = input.generics.clone();
    for parameter in generics.type_params_mut() {
        parameter.bounds.push(parse_quote!(#facade::core::Described));
        parameter.default = None;
    }
    for parameter in generics.const_params_mut() {
        parameter.default = None;
    }
    generics
}

fn layout(input: &DeriveInput, attributes: &TypeAttributes) -> Result<TokenStream> {
    let facade = &attributes.facade;
    let ident = &input.ident;
    let name = ident.unraw().to_string();
    let generics = described_generics(input, attributes);
    let (impl_generics, type_generics, where_clause) = generics.split_for_impl();
    let (shape, empty) = match &input.data {
        Data::Struct(data) => {
            let fields = fields(&data.fields, facade)?;
            let shape = quote! {
                #facade::core::contract::layout::Shape::Struct(::std::borrow::Cow::Borrowed(#name), #fields)
            };
            let fields = data.fields.iter().map(|field| described(&field.ty, facade));
            let empty = quote!(true #(&& #fields::EMPTY)*);
            (shape, empty)
        }
        Data::Enum(data) => {
            let variants = data.variants.iter().map(|variant| {
                refuse_on_variant(&variant.attrs)?;
                let name = variant.ident.unraw().to_string();
                let fields = fields(&variant.fields, facade)?;
                Ok(quote! {
                    #facade::core::contract::layout::Variant {
                        name: ::std::borrow::Cow::Borrowed(#name),
                        fields: #fields,
                    }
                })
            });
            let variants = all(variants)?;
            let shape = quote! {
                #facade::core::contract::layout::Shape::Enum(
                    ::std::borrow::Cow::Borrowed(#name),
                    ::std::borrow::Cow::Borrowed(const { &[#(#variants),*] }),
                )
            };
            (shape, quote!(false))
        }
        Data::Union(_) => unreachable!("unions were refused"),
    };
    Ok(quote! {
        #[automatically_derived]
        impl #impl_generics #facade::core::Described for #ident #type_generics #where_clause {
            const EMPTY: bool = #empty;

            fn layout() -> &'static #facade::core::Layout {
                const {
                    &#facade::core::Layout {
                        id: ::std::any::TypeId::of::<Self>,
                        shape: #shape,
                    }
                }
            }
        }
    })
}

fn fields(fields: &Fields, facade: &syn::Path) -> Result<TokenStream> {
    let kind = match fields {
        Fields::Unit => return Ok(quote!(#facade::core::contract::layout::Fields::Unit)),
        Fields::Unnamed(_) => quote!(Tuple),
        Fields::Named(_) => quote!(Named),
    };
    let fields = all(fields.iter().enumerate().map(|(index, field)| {
        let FieldAttributes { unit, frame, at_most } = FieldAttributes::parse(&field.attrs)?;
        let [unit, frame] = [unit, frame]
            .map(|text| option(text.map(|text| quote!(::std::borrow::Cow::Borrowed(#text)))));
        let name =
            field.ident.as_ref().map_or_else(|| index.to_string(), |i| i.unraw().to_string());
        let described = match at_most {
            None => described(&field.ty, facade),
            Some(bound) => {
                let of = &field.ty;
                quote_spanned!(of.span()=> #facade::core::contract::field::AtMost::<#of, #bound>)
            }
        };
        Ok(quote! {
            #facade::core::contract::layout::Field {
                name: ::std::borrow::Cow::Borrowed(#name),
                unit: #unit,
                frame: #frame,
                of: #described::layout,
            }
        })
    }))?;
    Ok(quote! {
        #facade::core::contract::layout::Fields::#kind(::std::borrow::Cow::Borrowed(const { &[#(#fields),*] }))
    })
}

/// A value that may be there.
pub(crate) fn option(tokens: Option<TokenStream>) -> TokenStream {
    match tokens {
        Some(tokens) => quote!(::std::option::Option::Some(#tokens)),
        None => quote!(::std::option::Option::None),
    }
}

/// The trait through which a field's type is described; arrays have one that knows any length.
fn described(of: &Type, facade: &syn::Path) -> TokenStream {
    match of {
        Type::Array(_) => {
            quote_spanned!(of.span()=> <#of as #facade::core::contract::layout::ArrayField>)
        }
        _ => quote_spanned!(of.span()=> <#of as #facade::core::Described>),
    }
}

/// Serde's two traits.
///
/// Serde's own derive writes the code, for a mirror of the type with `remote`, so that the user's
/// crate needs no serde and the type carries no attributes of it.
fn encoding(input: &DeriveInput, attributes: &TypeAttributes) -> TokenStream {
    let facade = &attributes.facade;
    let ident = &input.ident;
    let generics = described_generics(input, attributes);
    let (impl_generics, type_generics, where_clause) = generics.split_for_impl();
    let turbofish = type_generics.as_turbofish();
    let mut with_lifetime = generics.clone();
    with_lifetime.params.insert(0, GenericParam::Lifetime(parse_quote!('de)));
    let (impl_with_lifetime, _, _) = with_lifetime.split_for_impl();
    let mirror = mirror(input, attributes);
    quote! {
        #mirror

        #[automatically_derived]
        impl #impl_generics #facade::serde::Serialize for #ident #type_generics #where_clause {
            fn serialize<__S: #facade::serde::Serializer>(
                &self,
                to: __S,
            ) -> ::std::result::Result<__S::Ok, __S::Error> {
                #facade::core::contract::field::nested(
                    || __BlastemaMirror #turbofish::serialize(self, to),
                    <__S::Error as #facade::serde::ser::Error>::custom,
                )
            }
        }

        #[automatically_derived]
        impl #impl_with_lifetime #facade::serde::Deserialize<'de> for #ident #type_generics
        #where_clause
        {
            fn deserialize<__D: #facade::serde::Deserializer<'de>>(
                from: __D,
            ) -> ::std::result::Result<Self, __D::Error> {
                #facade::core::contract::field::nested(
                    || __BlastemaMirror #turbofish::deserialize(from),
                    <__D::Error as #facade::serde::de::Error>::custom,
                )
            }
        }
    }
}

fn mirror(input: &DeriveInput, attributes: &TypeAttributes) -> TokenStream {
    let facade = &attributes.facade;
    let facade_text = facade.to_token_stream().to_string();
    let serde_text = format!("{facade_text} :: serde");
    let remote_text = input.ident.to_string();

    let mut mirror = input.clone();
    mirror.ident = parse_quote!(__BlastemaMirror);
    mirror.vis = Visibility::Inherited;
    mirror.generics = described_generics(input, attributes);
    mirror.attrs = vec![
        parse_quote!(#[derive(#facade::serde::Serialize, #facade::serde::Deserialize)]),
        parse_quote!(#[serde(crate = #serde_text, remote = #remote_text)]),
        parse_quote!(#[allow(warnings, clippy::all, clippy::pedantic, clippy::restriction)]),
    ];
    match &mut mirror.data {
        Data::Struct(data) => mirror_fields(&mut data.fields, &facade_text),
        Data::Enum(data) => {
            for variant in &mut data.variants {
                variant.attrs.clear();
                variant.discriminant = None;
                mirror_fields(&mut variant.fields, &facade_text);
            }
        }
        Data::Union(_) => unreachable!("unions were refused"),
    }
    mirror.into_token_stream()
}

fn mirror_fields(fields: &mut Fields, facade_text: &str) {
    for field in fields {
        field.vis = Visibility::Inherited;
        field.attrs = vec![encoding_of(field, facade_text)];
    }
}

fn encoding_of(field: &Field, facade_text: &str) -> Attribute {
    // The attributes were parsed for the layout, which has reported what is wrong with them.
    let attributes = FieldAttributes::parse(&field.attrs).unwrap_or_default();
    let module = match (&field.ty, attributes.at_most) {
        (_, Some(bound)) => format!("AtMost :: < _ , {bound} >"),
        (Type::Array(_), _) => "array".to_owned(),
        (of, _) if is_bytes(of) => "bytes".to_owned(),
        _ => "plain".to_owned(),
    };
    let span = field.ty.span();
    let path =
        LitStr::new(&format!("{facade_text} :: core :: contract :: field :: {module}"), span);
    parse_quote_spanned!(span=> #[serde(with = #path)])
}

/// Whether a type is written `Vec<u8>`.
fn is_bytes(of: &Type) -> bool {
    let Type::Path(path) = of else { return false };
    let Some(last) = path.path.segments.last() else { return false };
    let PathArguments::AngleBracketed(arguments) = &last.arguments else { return false };
    let is_u8 = |argument: &GenericArgument| matches!(argument, GenericArgument::Type(Type::Path(path)) if path.path.is_ident("u8"));
    last.ident == "Vec" && arguments.args.len() == 1 && arguments.args.iter().all(is_u8)
}

/// All results, or all errors in one.
fn all(results: impl Iterator<Item = Result<TokenStream>>) -> Result<Vec<TokenStream>> {
    let mut items = Vec::new();
    let mut error: Option<Error> = None;
    for result in results {
        match (result, &mut error) {
            (Ok(item), _) => items.push(item),
            (Err(new), Some(error)) => error.combine(new),
            (Err(new), error) => *error = Some(new),
        }
    }
    error.map_or(Ok(items), Err)
}
