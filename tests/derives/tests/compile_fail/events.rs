//! What an event demands beyond its fields, and what a structure does not give.

use blastema::{Event, Request, Structure};

#[derive(Event)]
struct NotClone;

#[derive(Clone, Structure)]
struct OnlyStructure;

#[derive(Request)]
#[contract(reply = ())]
struct OnlyRequest;

fn publish<E: blastema::core::Event>(_: E) {}

fn send<M: blastema::core::Contract>(_: M) {}

fn ask<M: blastema::core::Request>(_: M) {}

fn main() {
    send(OnlyStructure);
    publish(OnlyRequest);
    ask(OnlyStructure);
    send(17u32);
}
