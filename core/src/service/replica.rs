//! One replica of a service.

mod accord;
mod component;
mod exposure;
mod outage;
mod primary;
mod rivals;
mod standby;
#[cfg(test)]
mod tests;
mod view;

use super::change::Change;
use super::message::{After, Message, Position, Served, Standing};
use super::table::Table;
use super::vocabulary::{ReplicaOutput, Role, ServiceOutcome, ServiceRequest};
use super::{OnPartition, ReplicaConfig, StandbyKind};
use crate::contract::codec;
use crate::sorted::SortedMap;
use crate::{DeliveryError, FaultKind, Instant, Machine, MessageId, NodeName};
use accord::Accord;
use bytes::Bytes;
use component::Health;
use outage::Outage;
use primary::{Follower, Primary, Step};
use standby::Standby;
use std::collections::VecDeque;

/// Requests that may wait for one service. Beyond, callers are told to slow down.
pub const QUEUE_MAX: usize = 256;
/// The most bytes of a component's state. Larger ones cannot be kept for the standbys.
pub const STATE_MAX: usize = 3 * 1024 * 1024;
/// The most bytes of one message between replicas: a state, and the table.
pub const MESSAGE_MAX: usize = 4 * 1024 * 1024;

/// What the component is to do, one after the other.
#[derive(Clone, Debug)]
enum Job {
    /// Serve a request, for the first time.
    Serve { id: MessageId, settled: u64, until: Option<Instant>, request: Bytes },
    /// Serve it again as the primary did.
    Replay { request: Bytes },
    /// Take over this state.
    Load { state: Bytes },
    /// Give the state, for standbys that are not in step.
    Save,
}

/// The machine of one service on one of its nodes.
#[derive(Debug)]
pub struct Replica {
    config: ReplicaConfig,
    /// The state that the component was built with.
    initial: Bytes,
    /// The greatest epoch in which somebody served, or in which we voted for another.
    epoch: u64,
    /// The greatest epoch that we claimed: our vote in it is our own.
    claimed: u64,
    position: Position,
    /// It was learned from another list, whose epochs and numbers may be those of our own, of
    /// something else.
    learned: bool,
    /// How far callers are known to have been answered, by whoever served.
    answered: Position,
    /// When somebody was last heard to serve.
    heard_at: Instant,
    /// The newest state, where standbys are warm.
    state: Option<Bytes>,
    table: Table,
    /// That the state cannot be kept for the standbys was told.
    state_refused: bool,
    role: Acting,
    /// As what it was last told of.
    told: Role,
    jobs: VecDeque<Job>,
    /// As of the last input that told it.
    now: Instant,
    /// The component is busy with this.
    working: Option<Job>,
    /// Since it was given that, it began a new life: what comes of it is of no account.
    void: bool,
    health: Health,
    accord: Accord,
    outage: Outage,
    /// What was said to be wrong here, and stands.
    faults: SortedMap<FaultKind, String>,
    refused: u64,
    outputs: VecDeque<ReplicaOutput>,
}

#[derive(Debug)]
enum Acting {
    Primary(Primary),
    Standby(Standby),
}

impl Replica {
    /// A replica that stands by. It votes for nobody for a lease: it may have promised so in a life
    /// that it does not remember. `initial` is the state of the component as it was built.
    pub fn new(config: ReplicaConfig, initial: Bytes, now: Instant) -> Self {
        let standby = Standby::beginning(&config, now);
        let mut replica = Replica {
            accord: Accord::new(&config),
            config,
            initial,
            epoch: 0,
            claimed: 0,
            position: Position::default(),
            learned: false,
            answered: Position::default(),
            heard_at: now,
            state: None,
            table: Table::default(),
            state_refused: false,
            role: Acting::Standby(standby),
            told: Role::Standby { primary: None, in_step: false },
            jobs: VecDeque::new(),
            now,
            working: None,
            void: false,
            health: Health::Whole,
            outage: Outage::beginning(now),
            faults: SortedMap::new(),
            refused: 0,
            outputs: VecDeque::new(),
        };
        // Cold standbys are given no state.
        if replica.config.kind != StandbyKind::Cold
            && let Err(why) = within_bounds(Ok(replica.initial.clone()))
        {
            replica.refuse_state(&why);
        }
        replica
    }

    /// What this replica is now.
    pub fn role(&self) -> Role {
        match &self.role {
            Acting::Primary(primary) => Role::Primary { epoch: primary.epoch },
            Acting::Standby(standby) => {
                let kept = standby.role(self.epoch, self.config.kind);
                match (kept, self.health) {
                    (Role::Standby { primary, .. }, Health::Bare { .. } | Health::Gone { .. }) => {
                        Role::Standby { primary, in_step: false }
                    }
                    (role, _) => role,
                }
            }
        }
    }

    /// Messages that were not understood, not believed, or not kept for want of room.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// A message came from another node than it says.
    pub fn handle_forged(&mut self) {
        self.refused += 1;
    }

    /// The services that this one depends on are served: it may take over, if it still wants to.
    pub fn handle_ready(&mut self, now: Instant) {
        let Acting::Standby(standby) = &mut self.role else { return };
        if standby.inquiring {
            standby.ready = true;
            self.claim(now);
        }
    }

    /// Somebody asks for the service.
    pub fn handle_request(&mut self, asked: ServiceRequest, now: Instant) {
        let ServiceRequest { caller, id, settled, until, request } = asked;
        self.handle_timeout(now);
        if let Some(difference) = self.dispute() {
            let why = DeliveryError::ContractDiffers { difference: difference.to_owned() };
            return self.answer(caller, ServiceOutcome::Refused(why));
        }
        if self.table.is_settled(id) {
            // It has wandered about while its caller was answered by another way: nobody waits.
            return self.answer(caller, ServiceOutcome::Refused(DeliveryError::Expired));
        }
        let served = self.table.find(id).cloned();
        let primary = match &mut self.role {
            Acting::Standby(standby) => {
                let elsewhere = ServiceOutcome::Elsewhere(standby.primary.clone());
                return self.answer(caller, elsewhere);
            }
            Acting::Primary(primary) => primary,
        };
        // The one who asks again is the one who waits.
        if let Some(waiting) = primary.waiting.get_mut(&id) {
            let before = std::mem::replace(waiting, caller);
            return self.answer(before, ServiceOutcome::Elsewhere(None));
        }
        match served {
            Some(served) => {
                self.answered = self.answered.max(primary.released);
                self.answer(caller, ServiceOutcome::Served(served.result.map(Bytes::from)));
            }
            None if primary.waiting.len() >= QUEUE_MAX => {
                self.answer(caller, ServiceOutcome::Refused(DeliveryError::Full));
            }
            None => {
                primary.waiting.insert(id, caller);
                self.jobs.push_back(Job::Serve { id, settled, until, request });
                self.work();
            }
        }
    }

    /// The component has served what it was to execute.
    pub fn handle_executed(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        state: Option<Result<Bytes, DeliveryError>>,
        now: Instant,
    ) {
        self.now = now;
        let void = std::mem::take(&mut self.void);
        if void && result.is_ok() && !matches!(state, Some(Err(_))) {
            self.serve_again();
            return self.work();
        }
        let (result, state) = self.kept(result, state);
        match self.working.take() {
            Some(Job::Serve { id, settled, request, .. }) => match (&mut self.role, result) {
                (_, Err(DeliveryError::Stopped | DeliveryError::Isolated { .. })) => {
                    self.handle_component_gone(now)
                }
                (Acting::Standby(_), _) if void => {}
                // It was begun while this replica served: it counts, should it serve again.
                (Acting::Standby(_), result) => self.note_late(id, result, state),
                // It did not get that far: the same request may come again.
                (
                    Acting::Primary(primary),
                    Err(why @ (DeliveryError::Restarting | DeliveryError::Full)),
                ) => {
                    let caller = primary.waiting.remove(&id);
                    caller.into_iter().for_each(|caller| {
                        self.answer(caller, ServiceOutcome::Refused(why.clone()));
                    });
                }
                (Acting::Primary(_), result) => {
                    self.commit_later((id, settled), request, result, state, now);
                }
            },
            Some(Job::Replay { .. }) => self.note_replayed(result, void, now),
            None => {}
            Some(other) => self.working = Some(other),
        }
        self.work();
    }

    /// What cannot be kept has not been done: the request fails, and the component is given back
    /// the state that it had before.
    fn kept(
        &mut self,
        result: Result<Bytes, DeliveryError>,
        state: Option<Result<Bytes, DeliveryError>>,
    ) -> (Result<Bytes, DeliveryError>, Option<Bytes>) {
        match (result, state.map(within_bounds)) {
            (Ok(reply), Some(Ok(state))) => {
                self.state_refused = false;
                (Ok(reply), Some(state))
            }
            (Ok(_), Some(Err(why))) => {
                self.refuse_state(&why);
                let state = self.last_state();
                self.jobs.push_front(Job::Load { state });
                (Err(why), None)
            }
            (result, state) => (result, state.and_then(Result::ok)),
        }
    }

    fn refuse_state(&mut self, why: &DeliveryError) {
        // That a component dies is told by others.
        let large = matches!(why, DeliveryError::TooLarge { .. });
        if large && !std::mem::replace(&mut self.state_refused, true) {
            let detail = format!(
                "its state cannot be kept for its standbys, of which none can take over: {why}; let it \
                 be smaller, or keep large things elsewhere"
            );
            let kind = FaultKind::CheckFailed;
            self.outputs.push_back(ReplicaOutput::Fault { kind, detail });
        }
    }

    /// The component has given its state, or could not.
    pub fn handle_saved(&mut self, state: Result<Bytes, DeliveryError>, now: Instant) {
        match self.working.take() {
            Some(Job::Save) => {
                let void = std::mem::take(&mut self.void);
                match within_bounds(state) {
                    Ok(_) if void => {}
                    Ok(state) => self.send_snapshots(&state, now),
                    Err(why) => self.refuse_state(&why),
                }
            }
            other => self.working = other,
        }
        self.work();
    }

    fn last_state(&self) -> Bytes {
        self.state.clone().unwrap_or_else(|| self.initial.clone())
    }

    /// The component has taken over a state, or could not.
    pub fn handle_loaded(&mut self) {
        self.end_load();
        self.confirm_state();
    }

    fn end_load(&mut self) {
        match self.working.take() {
            Some(Job::Load { .. }) => self.void = false,
            other => self.working = other,
        }
        self.work();
    }

    /// Another replica says something.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let read = self.accord.read(message).filter(|_| *from != self.config.own);
        let Some((message, signed)) = read else {
            self.refused += 1;
            return;
        };
        let agrees = self.accord.is_ours(signed);
        if !agrees {
            self.doubt(from, now);
        }
        let heard = match agrees {
            true => self.config.members.contains(from),
            false => self.accord.shares_state(from, signed),
        };
        let message = codec::decode_bounded::<Message, MESSAGE_MAX>(message);
        match message.ok().filter(|_| heard) {
            Some(message) if agrees => self.hear(from, message, now),
            Some(message) => self.hear_of_other_list((from, signed), message, now),
            None => self.refused += 1,
        }
    }

    fn hear(&mut self, from: &NodeName, message: Message, now: Instant) {
        self.handle_timeout(now);
        match message {
            Message::Hello { epoch, number, position, answered, heard } => {
                self.hear_hello(from, epoch, (number, position, answered), &heard, now);
            }
            Message::Promise { epoch, number, position, answered, standing } => {
                self.hear_loss(epoch, answered);
                self.hear_promise((from, false), epoch, number, (position, standing), now);
            }
            Message::Outdated { epoch } => match &self.role {
                Acting::Primary(primary) if epoch > primary.epoch => self.step_down(None, now),
                Acting::Primary(_) => {}
                Acting::Standby(_) => self.claimed = self.claimed.max(epoch),
            },
            // That somebody has claimed in vain deposes nobody.
            Message::Voted { epoch } => self.claimed = self.claimed.max(epoch),
            Message::Claim { epoch, position, heard } => {
                self.hear_claim(from, epoch, position, heard, now);
            }
            Message::Rival { terms } => self.hear_rival(&terms, now),
            Message::Vote { epoch, in_step, answered } => {
                self.hear_vote(from, epoch, (in_step, answered), now);
            }
            Message::Entry { epoch, position, served, settled, after } => {
                self.hear_entry((from, None), (epoch, position), served, settled, after);
            }
            Message::Snapshot { epoch, position, state, table } => {
                self.hear_snapshot((from, None), (epoch, position), state, table);
            }
            Message::Resigned { epoch } => self.hear_resigned(from, epoch, now),
        }
    }

    fn see(&mut self, epoch: u64) {
        self.epoch = self.epoch.max(epoch);
    }

    /// Gives the component the next job, if it has none.
    fn work(&mut self) {
        if self.working.is_some() {
            return;
        }
        if let Health::Gone { .. } = self.health {
            return self.jobs.clear();
        }
        let Some(job) = self.next_job() else { return };
        self.outputs.push_back(match &job {
            Job::Serve { request, .. } => {
                let save = self.config.kind == StandbyKind::Warm;
                ReplicaOutput::Execute { request: request.clone(), save }
            }
            Job::Replay { request } => {
                ReplicaOutput::Execute { request: request.clone(), save: false }
            }
            Job::Load { state } => ReplicaOutput::Load { state: state.clone() },
            Job::Save => ReplicaOutput::Save,
        });
        self.working = Some(job);
    }

    /// What is not to be begun any more is answered, and left out.
    fn next_job(&mut self) -> Option<Job> {
        loop {
            let job = self.jobs.pop_front()?;
            let Job::Serve { id, until: Some(until), .. } = &job else { return Some(job) };
            if self.now < *until {
                return Some(job);
            }
            if let Acting::Primary(primary) = &mut self.role
                && let Some(caller) = primary.waiting.remove(id)
            {
                self.answer(caller, ServiceOutcome::Refused(DeliveryError::DeadlinePassed));
            }
        }
    }

    /// This replica serves no more.
    fn step_down(&mut self, primary: Option<NodeName>, now: Instant) {
        let standby = Standby::following(&self.config, primary.clone(), now);
        let Acting::Primary(past) = std::mem::replace(&mut self.role, Acting::Standby(standby))
        else {
            return;
        };
        // What it did and nobody has is void; who asks again gets it from whoever follows.
        self.jobs.retain(|job| !matches!(job, Job::Serve { .. } | Job::Save));
        for caller in past.callers() {
            let outcome = match self.config.kind {
                // Nobody else knows of it.
                StandbyKind::Cold => {
                    let reason = "the primary stopped while it served".into();
                    ServiceOutcome::Served(Err(DeliveryError::OutcomeUnknown { reason }))
                }
                _ => ServiceOutcome::Elsewhere(primary.clone()),
            };
            self.answer(caller, outcome);
        }
        self.end_faults();
        self.tell_role();
    }

    /// Says what this replica has become, where that is something else.
    fn tell_role(&mut self) {
        let role = self.role();
        if role != self.told {
            self.told = role.clone();
            self.outputs.push_back(ReplicaOutput::Became(role));
        }
        self.note_served();
    }

    fn answer(&mut self, caller: u64, outcome: ServiceOutcome) {
        self.outputs.push_back(ReplicaOutput::Answer { caller, outcome });
    }

    fn send(&mut self, to: &NodeName, message: &Message) {
        let message = self.accord.sign(codec::encode_unbounded(message));
        self.outputs.push_back(ReplicaOutput::Send { to: to.clone(), message });
    }

    fn tell_others(&mut self, message: &Message) {
        let message = self.accord.sign(codec::encode_unbounded(message));
        let members = self.config.members.iter().filter(|member| **member != self.config.own);
        for to in members.cloned().chain(self.accord.unlisted()) {
            self.outputs.push_back(ReplicaOutput::Send { to, message: message.clone() });
        }
    }
}

/// A state that can be kept. One that did not even fit into the component's reply is too large like
/// any other: what has made it so is undone.
fn within_bounds(state: Result<Bytes, DeliveryError>) -> Result<Bytes, DeliveryError> {
    match state {
        Ok(state) if state.len() > STATE_MAX => Err(DeliveryError::TooLarge { limit: STATE_MAX }),
        Err(DeliveryError::ReplyTooLarge { .. }) => {
            Err(DeliveryError::TooLarge { limit: STATE_MAX })
        }
        other => other,
    }
}

impl Machine for Replica {
    type Output = ReplicaOutput;

    fn poll_output(&mut self) -> Option<ReplicaOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.role {
            Acting::Primary(primary) => Some(primary.due(&self.config, &self.accord)),
            Acting::Standby(standby) => {
                let told = self.outage.due(&self.config);
                Some(told.map_or(standby.due(), |told| told.min(standby.due())))
            }
        }
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.now = now;
        match &self.role {
            Acting::Primary(primary) if !primary.holds(&self.config, &self.accord, now) => {
                self.step_down(None, now);
            }
            Acting::Primary(primary) if now >= primary.hello_at => {
                self.say_hello(now);
                self.release(now);
            }
            Acting::Standby(standby) if now >= standby.claim_at => self.claim(now),
            Acting::Standby(standby) if now >= standby.due() => self.vote_late(now),
            Acting::Primary(_) | Acting::Standby(_) => {}
        }
        self.judge_outage(now);
    }
}
