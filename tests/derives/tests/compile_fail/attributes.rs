use blastema::{Event, Request, Structure, Variable};

#[derive(Clone, Event)]
#[contract(nmae = "laser/scan")]
struct Misspelt;

#[derive(Clone, Event)]
#[contract(colour = "red")]
struct Unknown;

#[derive(Clone, Event)]
#[contract(name = "a", name = "b")]
struct Twice;

#[derive(Clone, Event)]
#[contract(unit = "m")]
struct UnitOfAll {
    range: f32,
}

#[derive(Clone, Structure)]
struct NameOfField {
    #[contract(name = "x")]
    x: f32,
}

#[derive(Clone, Structure)]
struct MisspeltUnit {
    #[contract(units = "m")]
    x: f32,
}

#[derive(Clone, Structure)]
enum UnitOfVariant {
    #[contract(unit = "m")]
    Far,
}

#[derive(Clone, Structure)]
#[contract(name = "pose")]
struct NamedStructure;

#[derive(Clone, Event)]
#[contract(reply = f32)]
struct EventWithReply;

#[derive(Request)]
struct RequestWithoutReply;

#[derive(Variable)]
#[contract(max_age = "1s")]
struct VariableWithAge;

#[derive(Clone, Event)]
#[contract(when_full = "wait")]
struct WaitingEvent;

#[derive(Request)]
#[contract(reply = (), when_full = "refuse")]
struct RefusedRequest;

#[derive(Clone, Variable)]
#[contract(bulk)]
struct BulkVariable(f32);

fn main() {}
