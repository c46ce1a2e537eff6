//! `#[main]` and `#[test]`: async functions run by the middleware's runtime.

use proc_macro2::TokenStream;
use quote::quote;
use syn::{Error, ItemFn, Path, Result, ReturnType, Type, parse_quote};

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
    // Tests have a `main` of their own.
    let begin = attribute.is_none().then(|| quote!(#runtime::program::begin();));
    let fails = attribute.is_none() && returns_result(&function.sig.output);
    let ItemFn { attrs, vis, sig, block } = &mut function;
    if fails {
        // Else the standard library prints the error by `Debug`.
        let ReturnType::Type(_, output) = std::mem::replace(&mut sig.output, ReturnType::Default)
        else {
            return Err(Error::new(sig.ident.span(), "a result is returned"));
        };
        sig.output = parse_quote!(-> ::std::process::ExitCode);
        return Ok(quote! {
            #(#attrs)*
            #vis #sig {
                #begin
                let ended: #output = #runtime::run(async move #block);
                match ended {
                    ::core::result::Result::Ok(done) => ::std::process::Termination::report(done),
                    ::core::result::Result::Err(error) => {
                        use #runtime::program::*;
                        Fatal(error).report()
                    }
                }
            }
        });
    }
    Ok(quote! {
        #attribute
        #(#attrs)*
        #vis #sig {
            #begin
            #runtime::run(async move #block)
        }
    })
}

/// Whether the function is written to return a `Result`, by whichever path or alias of this name.
fn returns_result(output: &ReturnType) -> bool {
    let ReturnType::Type(_, output) = output else { return false };
    let Type::Path(path) = &**output else { return false };
    path.path.segments.last().is_some_and(|last| last.ident == "Result")
}
