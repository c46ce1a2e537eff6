//! What a watch reads of a component, as the product has it.

#[path = "../../../actors/src/liveness/activity.rs"]
#[expect(
    dead_code,
    unused_imports,
    reason = "the models use a part, and its unit tests do not run"
)]
pub(crate) mod activity;
