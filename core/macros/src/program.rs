//! `#[main]` and `#[test]`: async functions run by the middleware's runtime.

use proc_macro2::TokenStream;
use quote::quote;
use syn::{Error, ItemFn, Path, Result};

pub(crate) fn main(function: ItemFn, facade: &Path) -> Result<TokenStream> {
    run_in(function, facade, None)
}

pub(crate) fn test(function: ItemFn, testkit: &Path) -> Result<TokenStream> {
    run_in(function, testkit, Some(quote!(#[::core::prelude::v1::test])))
}

fn run_in(
    mut function: ItemFn,
    runtime: &Path,
    attribute: Option<TokenStream>,
) -> Result<TokenStream> {
    let name = &function.sig.ident;
    if function.sig.asyncness.take().is_none() {
        return Err(Error::new(name.span(), format!("write `async fn {name}`")));
    }
    if let Some(argument) = function.sig.inputs.first() {
        return Err(Error::new_spanned(argument, format!("`{name}` takes no arguments")));
    }
    if let Some(parameter) = function.sig.generics.params.first() {
        return Err(Error::new_spanned(parameter, format!("`{name}` cannot be generic")));
    }
    let ItemFn { attrs, vis, sig, block } = &function;
    Ok(quote! {
        #attribute
        #(#attrs)*
        #vis #sig {
            #runtime::run(async move #block)
        }
    })
}
