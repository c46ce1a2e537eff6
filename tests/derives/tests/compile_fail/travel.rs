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

fn main() {}
