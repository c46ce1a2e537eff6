//! Seals against an adversary that owns the medium: it delivers, drops, doubles, reorders, repeats
//! and changes frames, splices handshakes, and restarts nodes.
//!
//! The nodes have the double's cryptography, which panics when a nonce is used twice, so a run of
//! some thousand steps takes milliseconds. One run in ten has the product's. Which plans are run is
//! said by `BLASTEMA_SEED` and `BLASTEMA_SEEDS`, as in `robots`.

mod adversary;

use adversary::World;
use blastema_core::net::seal::{NoiseCrypto, SealProfile};
use blastema_doubles::{FakeCrypto, NonceLedger};

fn number(variable: &str, default: u64) -> u64 {
    let text = std::env::var(variable).ok();
    text.map_or(default, |text| text.parse().expect("a number"))
}

/// The seeds of this run, each announced in the text of a failure.
fn for_each_seed(default: u64, run: impl Fn(u64) + std::panic::RefUnwindSafe) {
    let first = number("BLASTEMA_SEED", 1);
    for seed in first..first + number("BLASTEMA_SEEDS", default) {
        // The reason was printed by then.
        let result = std::panic::catch_unwind(|| run(seed));
        assert!(result.is_ok(), "again with: BLASTEMA_SEED={seed} BLASTEMA_SEEDS=1");
    }
}

fn secret(node: u32) -> [u8; 32] {
    [node as u8 + 1; 32]
}

#[test]
fn whatever_an_adversary_does_each_frame_is_opened_once_as_its_senders_and_calm_heals_all() {
    for_each_seed(300, |seed| {
        let ledger = NonceLedger::default();
        let profile = if seed % 3 == 0 { SealProfile::Compact } else { SealProfile::Full };
        let mut world = World::new(
            seed,
            profile,
            |node| FakeCrypto::new(node, ledger.clone()),
            FakeCrypto::public_key,
        );
        world.attack(1_500);
        // On average 90: otherwise the attack shows nothing.
        assert!(world.opened() > 20, "{} frames were opened", world.opened());
        world.heal();
    });
}

#[test]
fn the_same_holds_with_the_products_cryptography() {
    for_each_seed(20, |seed| {
        let public = |node| NoiseCrypto::new(secret(node)).public_key();
        let crypto = |node| NoiseCrypto::new(secret(node));
        let mut world = World::new(seed, SealProfile::Full, crypto, public);
        world.attack(600);
        world.heal();
    });
}

#[test]
fn one_seed_gives_one_run_byte_for_byte() {
    let run = || {
        let ledger = NonceLedger::default();
        let crypto = |node| FakeCrypto::new(node, ledger.clone());
        let mut world = World::new(5, SealProfile::Full, crypto, FakeCrypto::public_key);
        world.attack(500);
        world.frames()
    };
    assert_eq!(run(), run());
}
