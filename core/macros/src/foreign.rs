//! What is refused in a contract by its look, with a message that says what to write instead.
//!
//! Other types that cannot stand in a contract are refused by the compiler, because they are not
//! `Described`.

use syn::spanned::Spanned;
use syn::visit::{self, Visit};
use syn::{Data, DeriveInput, Error, Expr, Result, Type, TypePath, TypePtr, TypeReference};

/// Refuses unions, enumerations without variants, borrowed data, and types that differ between
/// platforms or runs. All errors are reported at once.
pub(crate) fn refuse_foreign(input: &DeriveInput) -> Result<()> {
    let mut refusal = Refusal { error: None };
    if let Some(lifetime) = input.generics.lifetimes().next() {
        refusal.add(lifetime, OWNED);
    }
    match &input.data {
        Data::Union(data) => refusal.add(
            data.union_token,
            "a union does not say which of its fields holds: write an enum instead",
        ),
        Data::Enum(data) if data.variants.is_empty() => refusal.add(
            &input.ident,
            "an enumeration without variants has no values and cannot be sent: add a variant",
        ),
        _ => refusal.visit_data(&input.data),
    }
    refusal.error.map_or(Ok(()), Err)
}

const OWNED: &str =
    "a message owns its data: write `String` for `&str`, `Vec<T>` for `&[T]`, `T` for `&T`";

struct Refusal {
    error: Option<Error>,
}

impl Refusal {
    fn add(&mut self, at: impl Spanned, reason: &str) {
        let new = Error::new(at.span(), reason);
        match &mut self.error {
            Some(error) => error.combine(new),
            None => self.error = Some(new),
        }
    }
}

impl Visit<'_> for Refusal {
    fn visit_type_reference(&mut self, of: &TypeReference) {
        self.add(of, OWNED);
    }

    fn visit_type_ptr(&mut self, of: &TypePtr) {
        self.add(of, OWNED);
    }

    fn visit_type(&mut self, of: &Type) {
        match of {
            Type::BareFn(_) | Type::TraitObject(_) | Type::ImplTrait(_) => {
                self.add(of, "code does not travel: write an enum of what may be asked for instead")
            }
            _ => visit::visit_type(self, of),
        }
    }

    fn visit_type_path(&mut self, of: &TypePath) {
        let last = of.path.segments.last().map(|segment| segment.ident.to_string());
        let reason = match last.as_deref() {
            Some("usize") => "`usize` differs between platforms: write `u32` or `u64`",
            Some("isize") => "`isize` differs between platforms: write `i32` or `i64`",
            Some("HashMap") => "a `HashMap` has another order in each run: write `BTreeMap`",
            Some("HashSet") => "a `HashSet` has another order in each run: write `BTreeSet`",
            _ => return visit::visit_type_path(self, of),
        };
        self.add(of, reason);
    }

    // The length of an array is no part of the message.
    fn visit_expr(&mut self, _: &Expr) {}
}
