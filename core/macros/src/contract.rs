//! `#[derive(Event)]`, `#[derive(Request)]` and `#[derive(Variable)]`.

use crate::attributes::{Derive, TypeAttributes, wrong_name};
use crate::structure::{described_generics, expand};
use proc_macro2::TokenStream;
use quote::{quote, quote_spanned};
use syn::ext::IdentExt;
use syn::spanned::Spanned;
use syn::{DeriveInput, Error, Generics, Result, parse_quote};

pub(crate) fn derive(input: &DeriveInput, derive: Derive) -> Result<TokenStream> {
    let attributes = TypeAttributes::parse(&input.attrs, derive)?;
    let shared = quote!(::std::clone::Clone + ::std::marker::Send + ::std::marker::Sync);
    let (kind, bounds, reply) = match (derive, &attributes.reply) {
        (Derive::Structure, _) => return expand(input, &attributes),
        (Derive::Event, _) => (quote!(Event), shared, quote!(())),
        (Derive::Variable, _) => (quote!(Variable), shared, quote!(())),
        (Derive::Request, Some(reply)) => {
            (quote!(Request), quote!(::std::marker::Send), quote!(#reply))
        }
        (Derive::Request, None) => {
            return Err(Error::new(
                input.ident.span(),
                "a request needs a reply: write `#[contract(reply = Type)]`; `reply = ()` says only \
                 that it was served",
            ));
        }
    };
    let structure = expand(input, &attributes)?;
    let contract = contract(input, &attributes, &reply)?;
    let (ident, facade) = (&input.ident, &attributes.facade);
    let generics = bounded(input, &attributes, &bounds);
    let (impl_generics, type_generics, where_clause) = generics.split_for_impl();
    Ok(quote! {
        #structure
        #contract
        #[automatically_derived]
        impl #impl_generics #facade::core::#kind for #ident #type_generics #where_clause {}
    })
}

fn contract(
    input: &DeriveInput,
    attributes: &TypeAttributes,
    reply: &TokenStream,
) -> Result<TokenStream> {
    if attributes.name.is_none() && input.generics.params.iter().next().is_some() {
        return Err(Error::new(
            input.ident.span(),
            "a generic contract needs a name of its own: write `#[contract(name = \"..\")]`; all its \
             forms share that name and are told apart by their structure",
        ));
    }
    let TypeAttributes { name, version, max_size, max_age_nanos, from, delivery, facade, .. } =
        attributes;
    let ident = &input.ident;
    let default_name = ident.unraw().to_string();
    let name = match (name, wrong_name(&default_name)) {
        (Some(name), _) => quote!(#name),
        (None, None) => quote!(#default_name),
        (None, Some(reason)) => {
            let advice = "write `#[contract(name = \"..\")]`";
            return Err(Error::new(ident.span(), format!("{reason}: {advice}")));
        }
    };
    let version = version.map(|version| quote!(const VERSION: u16 = #version;));
    let size = max_size.as_ref().map(|size| {
        quote! {
            const MAX_SIZE: usize = {
                let size: usize = #size;
                ::std::assert!(
                    size > 0 && size <= #facade::core::contract::codec::SIZE_LIMIT,
                    "max_size is zero or above 16 MiB: send larger data in parts"
                );
                size
            };
        }
    });
    let age = max_age_nanos.map(|nanos| {
        quote! {
            const MAX_AGE: ::std::option::Option<::std::time::Duration> =
                ::std::option::Option::Some(::std::time::Duration::from_nanos(#nanos));
        }
    });
    let delivery = delivery.as_ref().map(|variant| {
        quote! {
            const DELIVERY: #facade::core::Delivery = #facade::core::Delivery::#variant;
        }
    });
    let flags = attributes.flags.iter().map(|flag| quote!(const #flag: bool = true;));
    let former = from.as_ref().map(|from| {
        // At the earlier version's name, so that a missing conversion is reported there.
        let chain =
            quote_spanned!(from.span()=> #facade::core::PreviousVersion::<Self>::chain::<#from>());
        quote! {
            fn previous_versions() -> ::std::vec::Vec<#facade::core::PreviousVersion<Self>> {
                #chain
            }
        }
    });
    let generics = bounded(input, attributes, &quote!(::std::marker::Send));
    let (impl_generics, type_generics, where_clause) = generics.split_for_impl();
    Ok(quote! {
        #[automatically_derived]
        impl #impl_generics #facade::core::Contract for #ident #type_generics #where_clause {
            type Reply = #reply;
            const NAME: &'static str = #name;
            #version
            #size
            #age
            #delivery
            #(#flags)*
            #former
        }
    })
}

/// The generics under which the type has what its contract demands. Without parameters nothing is
/// demanded here, so that the compiler names what is missing.
fn bounded(input: &DeriveInput, attributes: &TypeAttributes, bounds: &TokenStream) -> Generics {
    let mut generics = described_generics(input, attributes);
    if generics.type_params().next().is_some() {
        generics.make_where_clause().predicates.push(parse_quote!(Self: #bounds));
    }
    generics
}
