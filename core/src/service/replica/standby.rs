//! What a replica does while another one serves, or nobody does.

use super::*;
use std::time::Duration;

/// A replica that stands by.
#[derive(Debug)]
pub(super) struct Standby {
    /// Who serves, as far as is known.
    pub(super) primary: Option<NodeName>,
    /// By which other list that one serves; `None` where it is our own.
    list: Option<u64>,
    /// We vote for nobody else before.
    promised_until: Instant,
    /// When we want to serve ourselves, unless somebody else is heard of.
    pub(super) claim_at: Instant,
    /// Under which epoch the last snapshot came: since then nothing is missing.
    in_step: Option<u64>,
    /// What it has is everything up to its position.
    whole: bool,
    claiming: Option<Claiming>,
    /// It would claim, and has asked whether others are there.
    pub(super) inquiring: bool,
    /// They are; good for one claim.
    pub(super) ready: bool,
    /// Somebody claims while our promise still lasts: it is answered when that is over.
    asked: Option<(NodeName, u64, Position, Vec<u64>)>,
}

/// An epoch that was claimed.
#[derive(Debug)]
struct Claiming {
    epoch: u64,
    asked: Instant,
    /// How far we had come then.
    position: Position,
    /// And whether they have what we have.
    votes: SortedMap<NodeName, bool>,
}

impl Standby {
    fn waiting(config: &ReplicaConfig, primary: Option<NodeName>, now: Instant) -> Self {
        let promised_until = now + config.lease() + config.margin();
        Standby {
            claim_at: promised_until + turn(config, primary.as_ref()),
            primary,
            list: None,
            promised_until,
            in_step: None,
            whole: false,
            claiming: None,
            inquiring: false,
            ready: false,
            asked: None,
        }
    }

    /// When there is something to do.
    pub(super) fn due(&self) -> Instant {
        match self.asked {
            Some(_) => self.claim_at.min(self.promised_until),
            None => self.claim_at,
        }
    }

    pub(super) fn beginning(config: &ReplicaConfig, now: Instant) -> Self {
        Standby { whole: true, ..Standby::waiting(config, None, now) }
    }

    /// As what it stands by, while this epoch is the greatest that is known.
    pub(super) fn role(&self, epoch: u64, kind: StandbyKind) -> Role {
        let primary = self.primary.clone();
        // A cold one has nothing to know.
        let knows = kind == StandbyKind::Cold || self.in_step == Some(epoch);
        Role::Standby { in_step: knows && primary.is_some(), primary }
    }

    /// Whoever serves was told another list.
    pub(super) fn learns(&self) -> bool {
        self.primary.is_some() && self.list.is_some()
    }

    /// Whom we promised to vote for, serves no more.
    pub(super) fn release_promise(&mut self, now: Instant) {
        self.promised_until = self.promised_until.min(now);
    }

    /// Nobody is waited for that could not serve meanwhile.
    pub(super) fn hurry(&mut self, config: &ReplicaConfig, now: Instant) {
        let turn = turn(config, self.primary.as_ref());
        self.claim_at = self.claim_at.min(self.promised_until.max(now) + turn);
    }

    /// Votes for what it has do not count any more.
    pub(super) fn claim_no_more(&mut self) {
        self.claiming = None;
    }

    /// What this replica has is not what the primary has.
    pub(super) fn fall_behind(&mut self) {
        self.in_step = None;
        self.whole = false;
    }

    /// What it did last as primary, nobody else may have.
    pub(super) fn following(
        config: &ReplicaConfig,
        primary: Option<NodeName>,
        now: Instant,
    ) -> Self {
        Standby::waiting(config, primary, now)
    }
}

/// Those before us in the order of the members have their turn first, but for the one that has
/// gone.
fn turn(config: &ReplicaConfig, gone: Option<&NodeName>) -> Duration {
    let others = config.members.iter().filter(|member| Some(*member) != gone);
    let before = others.take_while(|member| **member != config.own).count();
    config.hello_interval / 2 * u32::try_from(before).unwrap_or(u32::MAX)
}

impl Replica {
    pub(super) fn hear_hello(
        &mut self,
        from: &NodeName,
        epoch: u64,
        (number, position, answered): (u64, Position, Position),
        heard: &[u64],
        now: Instant,
    ) {
        if epoch < self.epoch {
            return self.send(from, &Message::Outdated { epoch: self.epoch });
        }
        if let Acting::Primary(primary) = &self.role {
            // Two may serve under one epoch only where each half of a network goes on by itself.
            if (primary.epoch, from) > (epoch, &self.config.own) {
                return;
            }
            self.step_down(Some(from.clone()), now);
        }
        if !self.is_reckoned_with(from, heard) {
            return;
        }
        self.follow((from, None), epoch, (number, position, answered), now);
        if let Acting::Standby(standby) = &mut self.role {
            standby.promised_until = now + self.config.lease() + self.config.margin();
        }
    }

    /// This one serves, by whichever list.
    fn follow(
        &mut self,
        (from, list): (&NodeName, Option<u64>),
        epoch: u64,
        (number, position, answered): (u64, Position, Position),
        now: Instant,
    ) {
        self.see(epoch);
        self.answered = self.answered.max(answered);
        self.wait_for_state(now);
        let (telling, own, loading) = (self.tells_by_position(), self.position, self.is_loading());
        let comparable = telling && list.is_none() && !self.learned;
        let Acting::Standby(standby) = &mut self.role else { return };
        if standby.list != list {
            // Each list counts its own epochs.
            (standby.list, standby.in_step) = (list, None);
        }
        if comparable && standby.whole && position == own {
            standby.in_step = Some(epoch);
        } else if telling && position > own {
            // What makes the difference was sent before, to others.
            standby.in_step = None;
        }
        standby.primary = Some(from.clone());
        (standby.claiming, standby.asked, standby.inquiring) = (None, None, false);
        let patience = self.config.lease() + self.config.margin();
        standby.claim_at = now + patience + turn(&self.config, Some(from));
        let standing = match (self.config.kind, self.health) {
            (StandbyKind::Cold, _) => Standing::InStep,
            (StandbyKind::Hot, Health::Gone { .. }) => Standing::Unable,
            _ if standby.in_step != Some(epoch) => Standing::Behind,
            _ if loading => Standing::Coming,
            _ => Standing::InStep,
        };
        let (position, answered) = (self.position, self.answered);
        self.send(from, &Message::Promise { epoch, number, position, answered, standing });
        self.tell_role();
    }

    /// A node that was told another list, and nothing else otherwise, says something. While a list
    /// is changed, what was done by the old one is known by the new one, too: whoever serves is
    /// followed, without a promise.
    pub(super) fn hear_of_other_list(
        &mut self,
        (from, list): (&NodeName, u64),
        message: Message,
        now: Instant,
    ) {
        self.handle_timeout(now);
        let list = Some(list);
        let followed = match &self.role {
            Acting::Standby(standby) => standby.primary.as_ref() == Some(from),
            Acting::Primary(_) => false,
        };
        match message {
            Message::Hello { epoch, number, position, answered, .. } => {
                if let Acting::Standby(standby) = &self.role
                    && epoch >= self.epoch
                    // One of our own list goes first.
                    && (followed || standby.primary.is_none())
                {
                    self.follow((from, list), epoch, (number, position, answered), now);
                }
            }
            Message::Promise { epoch, number, position, answered, standing } => {
                self.hear_answered(answered, now);
                self.hear_promise((from, true), epoch, number, (position, standing), now);
            }
            Message::Entry { epoch, position, served, settled, after } if followed => {
                self.hear_entry((from, list), (epoch, position), served, settled, after);
            }
            Message::Snapshot { epoch, position, state, table } if followed => {
                self.hear_snapshot((from, list), (epoch, position), state, table);
            }
            Message::Resigned { epoch } if followed && epoch == self.epoch => {
                // What we have promised, we have promised to others.
                self.follow_nobody(now);
            }
            _ => {}
        }
    }

    /// Nobody serves: this replica offers to.
    pub(super) fn claim(&mut self, now: Instant) {
        let again = self.config.hello_interval + turn(&self.config, None);
        let barred = self.barred_until(now);
        let Acting::Standby(standby) = &mut self.role else { return };
        standby.claim_at = now + again;
        standby.primary = None;
        if self.accord.is_hopeless()
            || !self.accord.allows(|node| self.accord.may_support(node), now)
        {
            standby.inquiring = false;
            return self.tell_role();
        }
        if let Some(until) = barred {
            standby.claim_at = until;
            return self.tell_role();
        }
        if self.config.depends && !std::mem::take(&mut standby.ready) {
            if !std::mem::replace(&mut standby.inquiring, true) {
                self.outputs.push_back(ReplicaOutput::Inquire);
            }
            return self.tell_role();
        }
        standby.inquiring = false;
        if let Some(before) = &standby.claiming {
            let others = self.config.members.iter().filter(|member| **member != self.config.own);
            let unwilling = others.filter(|member| !before.votes.contains_key(*member));
            self.outage.note_vote(unwilling.cloned().collect());
        }
        self.tell_role();
        let epoch = self.epoch.max(self.claimed).saturating_add(1);
        self.claimed = epoch;
        let position = self.position;
        let Acting::Standby(standby) = &mut self.role else { return };
        standby.claiming = Some(Claiming { epoch, asked: now, position, votes: SortedMap::new() });
        if self.config.majority() == 1 || self.config.on_partition == OnPartition::Continue {
            if self.accord.allows(|node| *node == self.config.own, now) {
                self.take_over(epoch, now, [], now);
            }
            return;
        }
        let heard = self.accord.reckons_with(now);
        self.tell_others(&Message::Claim { epoch, position, heard });
    }

    pub(super) fn hear_claim(
        &mut self,
        from: &NodeName,
        epoch: u64,
        position: Position,
        heard: Vec<u64>,
        now: Instant,
    ) {
        if let Acting::Primary(_) = self.role {
            // It has not heard our hellos, but will.
            return;
        }
        let voted = self.epoch.max(self.claimed);
        if epoch <= voted {
            return self.send(from, &Message::Voted { epoch: voted });
        }
        let barred = self.barred_until(now);
        let (floor, learned) = (self.floor(now), self.learned);
        let Acting::Standby(standby) = &mut self.role else { return };
        if position < floor {
            if barred.is_some() {
                // Somebody else may know of more, and has it.
                self.claimed = self.claimed.max(epoch);
                return;
            }
            // We know of more: it is our turn.
            standby.claim_at = standby.claim_at.min(standby.promised_until.max(now));
            self.claimed = self.claimed.max(epoch);
            return self.handle_timeout(now);
        }
        if now < standby.promised_until {
            standby.asked = Some((from.clone(), epoch, position, heard));
            return;
        }
        if !self.is_reckoned_with(from, &heard) {
            return;
        }
        let Acting::Standby(standby) = &mut self.role else { return };
        // A vote is a promise as well.
        (standby.claiming, standby.asked) = (None, None);
        standby.promised_until = now + self.config.lease() + self.config.margin();
        standby.claim_at = standby.promised_until + turn(&self.config, None);
        let in_step = standby.whole && !learned && position == self.position;
        if in_step {
            standby.in_step = Some(epoch);
        }
        self.see(epoch);
        let answered = self.answered;
        self.send(from, &Message::Vote { epoch, in_step, answered });
    }

    /// The primary serves no more, and says so.
    pub(super) fn hear_resigned(&mut self, from: &NodeName, epoch: u64, now: Instant) {
        let Acting::Standby(standby) = &mut self.role else { return };
        // Since then, a promise may have been made to somebody else.
        if epoch != self.epoch || standby.primary.as_ref() != Some(from) {
            return;
        }
        standby.release_promise(now);
        self.follow_nobody(now);
    }

    fn follow_nobody(&mut self, now: Instant) {
        let Acting::Standby(standby) = &mut self.role else { return };
        standby.hurry(&self.config, now);
        standby.primary = None;
        self.tell_role();
        self.handle_timeout(now);
    }

    /// Our promise is over, and somebody claims.
    pub(super) fn vote_late(&mut self, now: Instant) {
        let Acting::Standby(standby) = &mut self.role else { return };
        if let Some((from, epoch, position, heard)) = standby.asked.take() {
            self.hear_claim(&from, epoch, position, heard, now);
        }
    }

    /// What was begun as primary has been served; nobody else knows of it.
    pub(super) fn note_late(
        &mut self,
        id: MessageId,
        result: Result<Bytes, DeliveryError>,
        state: Option<Bytes>,
    ) {
        if self.config.kind == StandbyKind::Cold {
            return;
        }
        self.position.number += 1;
        self.state = state.or(self.state.take());
        self.table.note(Served { id, result: result.map(Vec::from) });
    }

    /// Whether two replicas at one position have the same. Where each half of a network goes on by
    /// itself, two may have come to one position by different ways.
    pub(super) fn tells_by_position(&self) -> bool {
        self.config.on_partition == OnPartition::Stop && self.config.kind != StandbyKind::Cold
    }

    pub(super) fn hear_vote(
        &mut self,
        from: &NodeName,
        epoch: u64,
        (in_step, answered): (bool, Position),
        now: Instant,
    ) {
        self.answered = self.answered.max(answered);
        let in_step = in_step && self.tells_by_position();
        let Acting::Standby(standby) = &mut self.role else { return };
        let Some(claiming) = &mut standby.claiming else { return };
        if claiming.epoch != epoch || now - claiming.asked >= self.config.lease() {
            return;
        }
        claiming.votes.insert(from.clone(), in_step);
        let votes = &claiming.votes;
        let supports = |node: &NodeName| *node == self.config.own || votes.contains_key(node);
        if votes.len() + 1 >= self.config.majority() && self.accord.allows(supports, now) {
            let (asked, votes) = (claiming.asked, std::mem::take(&mut claiming.votes));
            // Those who voted have what we had then.
            let still = claiming.position == self.position;
            let voters = votes.into_iter().map(|(node, in_step)| (node, still && in_step));
            self.take_over(epoch, asked, voters, now);
        }
    }

    pub(super) fn hear_entry(
        &mut self,
        (from, list): (&NodeName, Option<u64>),
        (epoch, position): (u64, Position),
        served: Served,
        settled: u64,
        after: After,
    ) {
        let Acting::Standby(standby) = &mut self.role else { return };
        if epoch < self.epoch || standby.in_step != Some(epoch) || standby.list != list {
            return;
        }
        if position.number != self.position.number.saturating_add(1) {
            standby.fall_behind();
            return self.tell_role();
        }
        match after {
            After::State(change) => match change.apply(self.state.as_deref()) {
                Some(state) => self.state = Some(state.into()),
                // What it has is not what the primary takes it for.
                None => {
                    standby.fall_behind();
                    return self.tell_role();
                }
            },
            After::Request(request) => self.jobs.push_back(Job::Replay { request: request.into() }),
            After::Failed => {}
        }
        self.position = position;
        self.table.settle(served.id.sender, settled);
        self.table.note(served);
        self.work();
        self.confirm(from, epoch);
    }

    pub(super) fn hear_snapshot(
        &mut self,
        (from, list): (&NodeName, Option<u64>),
        (epoch, position): (u64, Position),
        state: Vec<u8>,
        table: Table,
    ) {
        let unable =
            self.config.kind == StandbyKind::Hot && matches!(self.health, Health::Gone { .. });
        let Acting::Standby(standby) = &mut self.role else { return };
        if epoch < self.epoch || unable {
            return;
        }
        (standby.list, standby.in_step) = (list, Some(epoch));
        standby.whole = true;
        self.learned = list.is_some();
        if let Health::Bare { .. } = self.health {
            self.health = Health::Whole;
        }
        self.see(epoch);
        self.position = position;
        self.table = table.bounded();
        // What is being served since before is in none of this.
        if let Some(Job::Serve { request, .. }) = &self.working {
            self.working = Some(Job::Replay { request: request.clone() });
        }
        match self.config.kind {
            StandbyKind::Hot => {
                self.jobs.clear();
                self.jobs.push_back(Job::Load { state: state.into() });
            }
            StandbyKind::Warm | StandbyKind::Cold => self.state = Some(state.into()),
        }
        self.work();
        self.confirm(from, epoch);
        self.tell_role();
    }

    /// A hot component has yet to take over what its replica was sent.
    fn is_loading(&self) -> bool {
        let mut jobs = self.jobs.iter().chain(&self.working);
        self.config.kind == StandbyKind::Hot && jobs.any(|job| matches!(job, Job::Load { .. }))
    }

    /// The component has what this replica has.
    pub(super) fn confirm_state(&mut self) {
        if let Acting::Standby(standby) = &self.role
            && let (Some(primary), Some(epoch)) = (standby.primary.clone(), standby.in_step)
            && self.config.kind == StandbyKind::Hot
        {
            self.confirm(&primary, epoch);
        }
    }

    /// Tells the primary how far we have come; this is no promise.
    fn confirm(&mut self, primary: &NodeName, epoch: u64) {
        if self.is_loading() {
            return;
        }
        let (position, answered, standing) = (self.position, self.answered, Standing::InStep);
        let message = Message::Promise { epoch, number: 0, position, answered, standing };
        self.send(primary, &message);
    }
}
