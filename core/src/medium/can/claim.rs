//! Whose an address of the bus is, after the model of SAE J1939-81.
//!
//! ```text
//!            claim sent        no objection for 250 ms
//! Claiming ─────────────────────────────────────────────► Held
//!     │ another node has precedence                         │ another node has precedence
//!     └─────────────────────────► Lost ◄────────────────────┘
//! ```
//!
//! A node that receives frames of another one under its address repeats its claim; the one who
//! comes second falls silent. Who has held the address for a while goes before who has just come,
//! so that a node that is plugged in with a wrong address does not put a running robot out of order
//! (J1939 decides by the name alone). Otherwise the lesser name goes first, and between two of one
//! name the lesser number, which each draws again.
//!
//! No node takes another address by itself: the neighbours are configured with this one.

use crate::{Instant, Machine};
use bytes::{BufMut, Bytes, BytesMut};
use std::collections::VecDeque;
use std::fmt;
use std::time::Duration;

/// The longest name that is said, in bytes.
const NAME_MAX: usize = 64;
/// How long others have to object, as in J1939-81.
const CLAIM_TIMEOUT: Duration = Duration::from_millis(250);
/// So long after a claim the next is said at the earliest: a flood of claims is not answered by
/// another.
const RETRY_DELAY: Duration = Duration::from_millis(50);
/// The same where something else is said under our address, which may be an echo of what we said.
const LONG_RETRY_DELAY: Duration = Duration::from_secs(1);
/// A rival that was silent for so long has gone, and is news when it is back.
const MEMORY: Duration = Duration::from_secs(10);
/// What a claim begins with: the version of its form.
const FORM: u8 = 1;

/// Who wants an address, or has it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AddressClaimed {
    /// It has held the address for a while.
    pub held: bool,
    /// Drawn by each claimant, so that two of one name are told apart, and an echo from
    /// another.
    pub number: u32,
    /// How people call it.
    pub name: String,
}

impl AddressClaimed {
    /// Whether it goes before another.
    fn precedes(&self, other: &AddressClaimed) -> bool {
        let rank = |claim: &AddressClaimed| (!claim.held, claim.name.clone(), claim.number);
        rank(self) < rank(other)
    }

    /// Its bytes, as a message to all.
    pub fn encode(&self) -> Bytes {
        let mut bytes = BytesMut::with_capacity(6 + self.name.len());
        bytes.put_u8(FORM);
        bytes.put_u8(u8::from(self.held));
        bytes.put_u32(self.number);
        bytes.put_slice(self.name.as_bytes());
        bytes.freeze()
    }

    /// Reads one; `None` for anything that [`encode`](AddressClaimed::encode) does not write.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (&[FORM, held @ 0..=1], rest) = bytes.split_first_chunk()? else { return None };
        let (number, name) = rest.split_first_chunk()?;
        let name = std::str::from_utf8(name).ok().filter(|name| name.len() <= NAME_MAX)?;
        let is_text = !name.chars().any(char::is_control);
        is_text.then(|| AddressClaimed {
            held: held == 1,
            number: u32::from_be_bytes(*number),
            name: name.to_owned(),
        })
    }
}

/// As an error names it.
impl fmt::Display for AddressClaimed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.name.as_str() {
            "" => write!(f, "a node without a name"),
            name => write!(f, "node {name}"),
        }
    }
}

/// What an [`AddressClaim`] wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AddressClaimOutput {
    /// Send this to all under the address.
    Say(AddressClaimed),
    /// The address is ours: others may hear us now.
    Held,
    /// Another wanted it, and is to fall silent. It is told once for each.
    Kept {
        /// The claim of the node that wanted it.
        from: AddressClaimed,
    },
    /// Another has it: be silent.
    Lost {
        /// The claim of the node that has it.
        to: AddressClaimed,
    },
}

/// The machine of one node's claim to its address.
#[derive(Debug)]
pub struct AddressClaim {
    own: AddressClaimed,
    state: State,
    claimed_at: Instant,
    /// It is to be said again, when the pause is over.
    owed: bool,
    /// The name of the one it was kept from last, and when he was heard last.
    rival: Option<(String, Instant)>,
    outputs: VecDeque<AddressClaimOutput>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Claiming { until: Instant },
    Held,
    Lost,
}

impl AddressClaim {
    /// Claims for the node of this name, which is cut off where it is too long.
    pub fn new(name: &str, number: u32, now: Instant) -> Self {
        let end = (0..=NAME_MAX.min(name.len())).rev().find(|end| name.is_char_boundary(*end));
        let name = name[..end.unwrap_or(0)].to_owned();
        let own = AddressClaimed { held: false, number, name };
        let outputs = VecDeque::from([AddressClaimOutput::Say(own.clone())]);
        let state = State::Claiming { until: now + CLAIM_TIMEOUT };
        AddressClaim { own, state, claimed_at: now, owed: false, rival: None, outputs }
    }

    /// Another node claims the address.
    pub fn handle_claim(&mut self, claim: AddressClaimed, now: Instant) {
        let is_echo = (claim.number, &claim.name) == (self.own.number, &self.own.name);
        if is_echo || self.state == State::Lost {
            return;
        }
        if claim.precedes(&self.own) {
            self.state = State::Lost;
            self.outputs.push_back(AddressClaimOutput::Lost { to: claim });
            return;
        }
        self.object(now);
        // One that tries again and again draws a new number each time: only another name is news.
        let known = self
            .rival
            .take()
            .is_some_and(|(name, received_at)| name == claim.name && now - received_at < MEMORY);
        self.rival = Some((claim.name.clone(), now));
        if !known {
            self.outputs.push_back(AddressClaimOutput::Kept { from: claim });
        }
    }

    /// Another node sends something else under our address: perhaps it does not know of us.
    pub fn handle_intruder(&mut self, now: Instant) {
        if self.state != State::Lost && now - self.claimed_at >= LONG_RETRY_DELAY {
            self.object(now);
        }
    }

    fn object(&mut self, now: Instant) {
        self.owed = now - self.claimed_at < RETRY_DELAY;
        if !self.owed {
            self.claimed_at = now;
            self.outputs.push_back(AddressClaimOutput::Say(self.own.clone()));
        }
    }
}

impl Machine for AddressClaim {
    type Output = AddressClaimOutput;

    fn poll_output(&mut self) -> Option<AddressClaimOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let settled = match self.state {
            State::Claiming { until } => Some(until),
            State::Held => None,
            State::Lost => return None,
        };
        let owed = self.owed.then(|| self.claimed_at + RETRY_DELAY);
        settled.into_iter().chain(owed).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        if let State::Claiming { until } = self.state
            && until <= now
        {
            (self.state, self.own.held) = (State::Held, true);
            self.outputs.push_back(AddressClaimOutput::Held);
        }
        if self.owed && self.state != State::Lost {
            self.object(now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn claim(held: bool, name: &str, number: u32) -> AddressClaimed {
        AddressClaimed { held, number, name: name.into() }
    }

    fn outputs(machine: &mut AddressClaim) -> Vec<AddressClaimOutput> {
        std::iter::from_fn(|| machine.poll_output()).collect()
    }

    /// One that has said its claim at 0 ms, and one that has held the address since.
    fn claiming() -> AddressClaim {
        let mut machine = AddressClaim::new("m", 5, at(0));
        assert_eq!(outputs(&mut machine), [AddressClaimOutput::Say(claim(false, "m", 5))]);
        machine
    }

    fn holding() -> AddressClaim {
        let mut machine = claiming();
        machine.handle_timeout(at(249));
        assert_eq!(outputs(&mut machine), []);
        machine.handle_timeout(at(250));
        assert_eq!(outputs(&mut machine), [AddressClaimOutput::Held]);
        machine
    }

    #[test]
    fn who_has_held_it_goes_first_then_the_lesser_name_then_the_lesser_number() {
        let check = |mut machine: AddressClaim, other: AddressClaimed, lost: bool| {
            let now = at(1_000);
            machine.handle_claim(other.clone(), now);
            let own = machine.own.clone();
            let expected = if lost {
                vec![AddressClaimOutput::Lost { to: other }]
            } else {
                vec![AddressClaimOutput::Say(own), AddressClaimOutput::Kept { from: other }]
            };
            assert_eq!(outputs(&mut machine), expected);
        };
        check(claiming(), claim(true, "z", 9), true);
        check(claiming(), claim(false, "a", 9), true);
        check(claiming(), claim(false, "z", 1), false);
        check(claiming(), claim(false, "m", 4), true);
        check(claiming(), claim(false, "m", 6), false);
        check(holding(), claim(true, "z", 1), false);
        check(holding(), claim(true, "a", 9), true);
        check(holding(), claim(false, "a", 1), false);
        check(holding(), claim(true, "m", 4), true);
    }

    #[test]
    fn of_two_that_begin_together_one_stays() {
        for (a, b) in [("a", "b"), ("m", "m")] {
            let mut nodes = [AddressClaim::new(a, 1, at(0)), AddressClaim::new(b, 2, at(0))];
            let mut reported = [vec![], vec![]];
            for millis in 0..1_000 {
                for from in 0..2 {
                    nodes[from].handle_timeout(at(millis));
                    for output in outputs(&mut nodes[from]) {
                        match output {
                            AddressClaimOutput::Say(claim) => {
                                nodes[1 - from].handle_claim(claim, at(millis))
                            }
                            other => reported[from].push(other),
                        }
                    }
                }
            }

            let [first, second] = reported;
            assert!(
                matches!(&first[..], [AddressClaimOutput::Kept { from }, AddressClaimOutput::Held] if from.name == b)
            );
            assert!(matches!(&second[..], [AddressClaimOutput::Lost { to }] if to.name == a));
        }
    }

    #[test]
    fn an_echo_of_our_own_is_no_rival() {
        for held in [false, true] {
            let mut machine = holding();
            machine.handle_claim(claim(held, "m", 5), at(900));
            assert_eq!(outputs(&mut machine), []);
        }
    }

    #[test]
    fn whoever_speaks_under_our_address_is_told_whose_it_is_once_in_a_second() {
        let mut machine = holding();

        (300..3_300).for_each(|millis| machine.handle_intruder(at(millis)));

        let say = AddressClaimOutput::Say(claim(true, "m", 5));
        assert_eq!(outputs(&mut machine), [say.clone(), say.clone(), say]);
    }

    #[test]
    fn a_flood_of_claims_is_answered_twenty_times_a_second_and_the_last_is_answered() {
        let mut machine = holding();
        let mut claimed_at = 0;
        for millis in 1_000..2_000 {
            machine.handle_claim(claim(false, "z", 1), at(millis));
            machine.handle_timeout(at(millis));
            let reported = outputs(&mut machine);
            claimed_at += reported
                .iter()
                .filter(|output| matches!(output, AddressClaimOutput::Say(_)))
                .count();
        }
        assert_eq!(claimed_at, 20);
        assert_eq!(machine.poll_timeout(), Some(at(2_000)));

        machine.handle_timeout(at(2_000));

        assert_eq!(outputs(&mut machine), [AddressClaimOutput::Say(claim(true, "m", 5))]);
        assert_eq!(machine.poll_timeout(), None);
    }

    #[test]
    fn one_that_tries_again_and_again_is_told_of_once_until_it_was_gone_for_a_while() {
        let mut machine = holding();
        let mut kept = Vec::new();
        let seconds = (1..20).chain(40..50);
        for second in seconds {
            machine.handle_claim(claim(false, "z", second), at(1_000 * u64::from(second)));
            let reported = outputs(&mut machine);
            assert!(reported.iter().any(|output| matches!(output, AddressClaimOutput::Say(_))));
            if reported.iter().any(|output| matches!(output, AddressClaimOutput::Kept { .. })) {
                kept.push(second);
            }
        }
        assert_eq!(kept, [1, 40]);
    }

    #[test]
    fn who_has_lost_is_silent_for_good() {
        let mut machine = claiming();
        machine.handle_claim(claim(true, "z", 9), at(10));
        outputs(&mut machine);

        machine.handle_claim(claim(false, "z", 9), at(500));
        machine.handle_intruder(at(500));
        machine.handle_timeout(at(500));

        assert_eq!((outputs(&mut machine), machine.poll_timeout()), (vec![], None));
    }

    #[test]
    fn a_claim_comes_back_as_it_was_and_nothing_else_does() {
        let bytes = claim(true, "module1", 0x0102_0304).encode();
        assert_eq!(&bytes[..], b"\x01\x01\x01\x02\x03\x04module1");
        assert_eq!(AddressClaimed::decode(&bytes), Some(claim(true, "module1", 0x0102_0304)));
        for wrong in [
            &b""[..],
            b"\x01\x01\x01\x02\x03",
            b"\x02\x01abcdm",
            b"\x01\x02abcdm",
            b"\x01\x01abcd\xff",
        ] {
            assert_eq!(AddressClaimed::decode(wrong), None, "{wrong:02x?}");
        }
        assert_eq!(
            AddressClaimed::decode(&[&bytes[..6], &[b'm'; 65]].concat()),
            None,
            "no name is so long"
        );
        assert_eq!(
            AddressClaimed::decode(&[&bytes[..6], b"a\nb"].concat()),
            None,
            "no line of a log"
        );
        let long = AddressClaim::new(&"\u{e4}".repeat(40), 1, at(0));
        assert_eq!(long.own.name.len(), 64);
    }
}
