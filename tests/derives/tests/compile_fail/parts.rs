//! Types that only the compiler can tell to be unfit.

use blastema::{Event, Request, Structure};
use std::time::Instant;

struct Plain;

type Count = usize;

#[derive(Clone, Event)]
struct WithInstant {
    since: Instant,
}

#[derive(Request)]
#[contract(reply = Plain)]
struct WithPlainReply;

#[derive(Structure)]
struct WithPlain {
    plain: Option<Vec<Plain>>,
}

#[derive(Structure)]
enum WithAlias {
    Count(Count),
}

#[derive(Structure)]
struct WithLongInner {
    matrix: Vec<[f64; 36]>,
}

#[derive(Structure)]
struct WithBoundedNumber {
    #[contract(at_most = 16)]
    number: u32,
}

fn main() {}
