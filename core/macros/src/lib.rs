//! Derives for the contracts of the Blastema middleware, and its `main` and `test`.
//!
//! Use them through the crate `blastema`, which re-exports all but `test`; that one comes with
//! `blastema-testkit`. The code that the derives write refers to `::blastema::core` and
//! `::blastema::serde`; `#[contract(crate = "path")]` names another place where these two are
//! found.

mod attributes;
mod contract;
mod foreign;
mod parameters;
mod program;
mod spelling;
mod structure;

use attributes::Derive;
use proc_macro::TokenStream;
use syn::{DeriveInput, ItemFn, Path, Result, parse_macro_input, parse_quote};

/// Makes a type part of messages: its structure becomes data and it can be encoded.
///
/// Fields take `#[contract(unit = "m", frame = "laser")]`, which parties compare when they bind.
/// Structures nest at most 32 deep in one message.
///
/// ```text
/// #[derive(Clone, Debug, Structure)]
/// struct Pose {
///     #[contract(unit = "m", frame = "map")]
///     x: f64,
///     #[contract(unit = "m", frame = "map")]
///     y: f64,
/// }
/// ```
#[proc_macro_derive(Structure, attributes(contract, serde))]
pub fn structure(input: TokenStream) -> TokenStream {
    derived(input, Derive::Structure)
}

/// Makes a type an event: a message without an answer, which may have many listeners.
///
/// | key | meaning | if left out |
/// | --- | --- | --- |
/// | `name = "laser/scan"` | by which both parties know it | the type's identifier |
/// | `version = 2` | raised when the meaning changes | 1 |
/// | `max_size = 4096` | most bytes of an encoded message | 64 KiB |
/// | `from = PoseV1` | the version before, which a receiver converts by `From`; a request's reply is converted back | none |
/// | `delivery = "redundant"` | how it travels between nodes: `reliable`, `newest`, `redundant` | `reliable` |
/// | `max_age = "100ms"` | older ones are not delivered but counted | no limit |
/// | `bulk` | messages are large, and may wait for others on their way to other nodes | they do not |
/// | `latched` | the last event of a topic is kept, and given to each listener that joins | not kept |
/// | `when_full = "refuse"` | where a node that listens has no capacity, `publish` fails and no listener gets the event | `drop`: that node loses it, and it is counted |
///
/// ```text
/// /// One sweep of the laser.
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "laser/scan", version = 1, max_age = "100ms")]
/// struct Scan {
///     #[contract(unit = "m", frame = "laser")]
///     ranges: Vec<f32>,
/// }
/// ```
#[proc_macro_derive(Event, attributes(contract, serde))]
pub fn event(input: TokenStream) -> TokenStream {
    derived(input, Derive::Event)
}

/// Makes a type a request: a message with one answer.
///
/// `reply = Type` is required; `name`, `version` and `max_size` are those of [`Event`]. The limit
/// in size holds for the reply too.
///
/// ```text
/// #[derive(Debug, Request)]
/// #[contract(reply = f32)]
/// struct Nearest {
///     #[contract(unit = "rad")]
///     within: f32,
/// }
/// ```
#[proc_macro_derive(Request, attributes(contract, serde))]
pub fn request(input: TokenStream) -> TokenStream {
    derived(input, Derive::Request)
}

/// Makes a type a variable: a value that an object owns, and that any node may read, write and
/// watch.
///
/// `name`, `version` and `max_size` are those of [`Event`].
///
/// ```text
/// /// How fast the arm may move.
/// #[derive(Clone, Debug, Variable)]
/// #[contract(name = "arm/speed-limit")]
/// struct SpeedLimit {
///     #[contract(unit = "rad/s")]
///     value: f32,
/// }
/// ```
#[proc_macro_derive(Variable, attributes(contract, serde))]
pub fn variable(input: TokenStream) -> TokenStream {
    derived(input, Derive::Variable)
}

/// Makes a struct the parameters of a component: settings with defaults, units and ranges. It is a
/// [`Variable`] as well, and gets `Default`.
///
/// | key of `#[parameter(..)]` | meaning | if left out |
/// | --- | --- | --- |
/// | `default = 0.5` | the value unless another is given | the type's `Default` |
/// | `range = 0.0..=2.0` | a value outside of it is refused | no bounds |
/// | `unit = "m/s"` | shown in errors, and compared when parties bind | none |
///
/// Parameters are `bool`, whole numbers up to 64 bits, `f32`, `f64`, `String`, enums that derive
/// [`ParameterType`], and a `Vec` of these, each element of which lies in the range.
///
/// ```text
/// #[derive(Clone, Debug, Parameters)]
/// struct ArmParameters {
///     #[parameter(default = 0.5, range = 0.0..=2.0, unit = "m/s")]
///     max_speed: f64,
/// }
/// ```
#[proc_macro_derive(Parameters, attributes(parameter, contract, serde))]
pub fn parameters(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    tokens(parameters::derive(&input))
}

/// Makes an enum without fields the type of a parameter, which takes a variant by its name. It is a
/// [`Structure`] as well.
///
/// ```text
/// #[derive(Clone, Debug, Default, ParameterType)]
/// enum Grip {
///     #[default]
///     Soft,
///     Firm,
/// }
/// ```
#[proc_macro_derive(ParameterType, attributes(contract, serde))]
pub fn parameter_type(input: TokenStream) -> TokenStream {
    let input = parse_macro_input!(input as DeriveInput);
    tokens(parameters::derive_type(&input))
}

/// Runs an async `main` in the middleware's runtime, by `::blastema::run`.
///
/// ```
/// # mod blastema {
/// #     pub use blastema_macros::main;
/// #     pub fn run<F: Future<Output = ()>>(_: F) {}
/// #     pub mod program {
/// #         pub fn begin() {}
/// #     }
/// # }
/// #[blastema::main(crate = "crate::blastema")] // `#[blastema::main]` where the facade is used
/// async fn main() {
///     // ..
/// }
/// ```
#[proc_macro_attribute]
pub fn main(arguments: TokenStream, item: TokenStream) -> TokenStream {
    let mut facade: Path = parse_quote!(::blastema);
    let parser = syn::meta::parser(|meta| attributes::parse_crate(&meta, &mut facade));
    parse_macro_input!(arguments with parser);
    tokens(program::main(parse_macro_input!(item as ItemFn), &facade))
}

/// Runs an async test in the test kit's runtime, by `::blastema_testkit::run`; time stands still in
/// it until it is advanced.
///
/// ```
/// # mod blastema_testkit {
/// #     pub use blastema_macros::test;
/// #     pub fn run<F: Future<Output = ()>>(_: F) {}
/// # }
/// #[blastema_testkit::test(crate = "crate::blastema_testkit")] // in short: `#[blastema_testkit::test]`
/// async fn a_laser_answers() {
///     // ..
/// }
/// # fn main() {}
/// ```
#[proc_macro_attribute]
pub fn test(arguments: TokenStream, item: TokenStream) -> TokenStream {
    let mut testkit: Path = parse_quote!(::blastema_testkit);
    let parser = syn::meta::parser(|meta| attributes::parse_crate(&meta, &mut testkit));
    parse_macro_input!(arguments with parser);
    tokens(program::test(parse_macro_input!(item as ItemFn), &testkit))
}

fn derived(input: TokenStream, derive: Derive) -> TokenStream {
    tokens(contract::derive(&parse_macro_input!(input as DeriveInput), derive))
}

fn tokens(result: Result<proc_macro2::TokenStream>) -> TokenStream {
    result.unwrap_or_else(|error| error.into_compile_error()).into()
}
