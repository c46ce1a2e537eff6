use blastema::prelude::*;

#[derive(Clone, Parameters)]
struct Misspelt {
    #[parameter(defualt = 1)]
    attempts: u8,
}

#[derive(Clone, Parameters)]
struct Twice {
    #[parameter(default = 1, default = 2)]
    attempts: u8,
}

#[derive(Clone, Parameters)]
struct Unnamed(u8);

#[derive(Clone, Parameters)]
enum Choice {
    One,
}

#[derive(Clone, Parameters)]
struct Generic<T> {
    attempts: T,
}

#[derive(Clone, Parameters)]
struct Listed {
    attempts: Vec<u8>,
}

fn main() {}
