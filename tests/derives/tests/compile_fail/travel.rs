use blastema::{Event, Request};

#[derive(Clone, Event)]
#[contract(delivery = "redundent")]
struct Misspelt;

#[derive(Clone, Event)]
#[contract(delivery = "by ship")]
struct Unknown;

#[derive(Request)]
#[contract(reply = u8, delivery = "newest")]
struct Unanswered;

#[derive(Clone, Event)]
#[contract(idempotent)]
struct NeverRepeated;

mod versions {
    use blastema::Event;

    #[derive(Clone, Event)]
    #[contract(name = "speed")]
    pub struct SpeedV1(pub u32);

    #[derive(Clone, Event)]
    #[contract(name = "speed", version = 2, from = SpeedV1)]
    pub struct Unconverted(pub f32);
}

fn main() {}
