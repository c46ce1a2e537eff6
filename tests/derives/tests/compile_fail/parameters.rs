use blastema::prelude::*;

#[derive(Clone, Debug, Parameters)]
struct Misspelt {
    #[parameter(defualt = 1)]
    attempts: u8,
}

#[derive(Clone, Debug, Parameters)]
struct Twice {
    #[parameter(default = 1, default = 2)]
    attempts: u8,
}

#[derive(Clone, Debug, Parameters)]
struct Unnamed(u8);

#[derive(Clone, Debug, Parameters)]
enum Choice {
    One,
}

#[derive(Clone, Debug, Parameters)]
struct Generic<T> {
    attempts: T,
}

#[derive(Clone, Debug, ParameterType)]
enum Carrying {
    Nothing,
    Mass(u8),
}

#[derive(Clone, Debug, ParameterType)]
struct Plain;

fn main() {}
