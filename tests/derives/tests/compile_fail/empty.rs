//! Values without bytes in a sequence: a few hostile bytes could announce 2^64 of them.

use blastema::Event;

#[derive(Clone, Event)]
struct Ticks(Vec<()>);

fn main() {
    let _ = blastema::core::contract::codec::decode::<Ticks>(&[1]);
}
