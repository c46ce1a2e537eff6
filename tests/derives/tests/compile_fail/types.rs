use blastema::{Event, Structure};
use std::collections::{HashMap, HashSet};

#[derive(Clone, Event)]
struct Platform {
    count: usize,
    nested: Option<Vec<(isize, u8)>>,
}

#[derive(Clone, Event)]
struct Unordered {
    map: HashMap<String, u32>,
    set: std::collections::HashSet<u32>,
}

#[derive(Clone, Event)]
struct Borrowed<'a> {
    text: &'a str,
}

#[derive(Clone, Event)]
struct BorrowedForEver(&'static str, Vec<&'static [u8]>);

#[derive(Structure)]
struct Code {
    run: fn(u32) -> u32,
    boxed: Box<dyn Send>,
    pointer: *const u8,
}

#[derive(Clone, Copy, Structure)]
union Either {
    a: u32,
    b: f32,
}

#[derive(Clone, Structure)]
enum Never {}

#[derive(Clone, Event)]
struct Unnamed<T> {
    value: T,
}

fn main() {
    let _: Option<HashSet<u8>> = None;
}
