use blastema::{Event, Structure};

#[derive(Clone, Event)]
#[contract(name = "laser scan")]
struct BlankInName;

#[derive(Clone, Event)]
#[contract(name = "laser//scan")]
struct EmptyPartOfName;

#[derive(Clone, Event)]
#[contract(version = 70000)]
struct LargeVersion;

#[derive(Clone, Event)]
#[contract(max_age = "100")]
struct AgeWithoutUnit;

#[derive(Clone, Event)]
#[contract(max_age = 100)]
struct AgeAsNumber;

#[derive(Clone, Event)]
#[contract(max_age = "0s")]
struct NoAge;

#[derive(Clone, Structure)]
struct EmptyUnit {
    #[contract(unit = "")]
    x: f32,
}

#[derive(Clone, Event)]
#[contract]
struct NoKeys;

#[derive(Clone, Event)]
struct Größe(f32);

#[derive(Clone, Structure)]
struct NoRoom {
    #[contract(at_most = 0)]
    names: Vec<u8>,
}

fn main() {}
