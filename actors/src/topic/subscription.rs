//! A component's subscription to one topic: at which hub it is served, and from which event on.

use super::entry::Resident;
use super::hub::ListenerEntry;
use super::hub_queue::HubQueue;
use super::{EventFilter, Topic, Topics, lock};
use crate::component::cell::ComponentCell;
use crate::component::environment::ComponentEnvironment;
use crate::component::subscription::Subscription;
use crate::component::{Component, Handle};
use blastema_core::{DeliveryError, Event, Incarnation, ObjectName};
use std::cell::{Cell, RefCell};
use std::panic::Location;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};

/// A component's subscription to one topic.
pub(crate) struct TopicSubscription<E: Event> {
    topic: Arc<Topic<E>>,
    only_if: Option<EventFilter<E>>,
    /// Where the program declares it.
    at: &'static Location<'static>,
    /// The number of the entry that is served now; 0 for none.
    present: Arc<AtomicU64>,
    /// The hub that serves the attached incarnation; `None` while none is attached.
    hub: Mutex<Option<At<E>>>,
}

/// The condition that was to decide on an event went down with its incarnation.
fn lose_undecided<C: Component, E: Event>(cell: &ComponentCell<C>, incarnation: u64) {
    let why = DeliveryError::PeerDied { incarnation: Incarnation(incarnation) };
    cell.record.record_dead_letter(E::NAME, &why);
}

/// Where a subscription is served, and from which of the topic's events on.
struct At<E> {
    queue: Arc<HubQueue<E>>,
    since: u64,
}

impl<E: Event> TopicSubscription<E> {
    pub(crate) fn new(
        topic: Arc<Topic<E>>,
        only_if: Option<EventFilter<E>>,
        at: &'static Location<'static>,
    ) -> Self {
        TopicSubscription { topic, only_if, at, present: Arc::default(), hub: Mutex::default() }
    }
}

impl<C: Handle<E>, E: Event> Subscription<C> for TopicSubscription<E> {
    fn attach(&self, cell: &Arc<ComponentCell<C>>) {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        // No event passes between what the topic keeps and what the listener gets from here on.
        let latch = lock(&self.topic.latch);
        let mut at = lock(&self.hub);
        let mut hubs = lock(&self.topic.hubs);
        let hub = self.topic.hub_here(&mut hubs);
        if let Some(At { queue, since }) = at.as_ref().filter(|at| at.queue.id == hub.shared.id) {
            let entry = self.present.load(Relaxed);
            // The last event, unless it is yet to come.
            if latch.is_some() && !queue.awaits(entry, *since) {
                queue.bring(entry, self.topic.kept(&latch));
            }
            return;
        }
        let (number, since) = (NEXT.fetch_add(1, Relaxed), hubs.next);
        let leave = || self.present.swap(number, Relaxed);
        // What still waits at the hub that the listener leaves: its arbiter is lost, or the
        // listener moves and would miss it.
        let mut left = match &*at {
            Some(At { queue, since }) => {
                let is_undecided = Cell::new(false);
                let leftover = || queue.leftover(*since, leave, &is_undecided);
                let left = self.topic.guarded(leftover).unwrap_or_default();
                if is_undecided.get() {
                    // The incarnation before this one decided on it when it died.
                    lose_undecided::<C, E>(cell, cell.record.incarnation().0.saturating_sub(1));
                }
                left
            }
            None => {
                leave();
                Vec::new()
            }
        };
        if left.is_empty() {
            left = self.topic.kept(&latch);
        }
        hub.shared.listeners.fetch_add(1, Relaxed);
        let joins = at.is_none().then(|| self.topic.add_listener(&latch));
        drop((hubs, latch));
        let mut newcomers = hub.newcomers.borrow_mut();
        newcomers.retain(ListenerEntry::is_present);
        newcomers.push(ListenerEntry {
            only_if: self.only_if.clone(),
            present: self.present.clone(),
            number,
            since,
            activity_slot: Cell::new(None),
            listener: Box::new(Resident {
                cell: cell.clone(),
                port: cell.port_of_topic::<E>(self.topic.key.topic.as_str()),
                executor: RefCell::default(),
            }),
        });
        drop(newcomers);
        hub.shared.bring(number, left);
        if let Some(old) = at.replace(At { queue: hub.shared.clone(), since }) {
            self.topic.leave(&old.queue);
        }
        if let Some(is_first) = joins {
            self.topic.listener_changed(&cell.record.name, true, is_first);
        }
    }

    fn topic(&self) -> &ObjectName {
        &self.topic.key.topic
    }

    fn is_attached(&self) -> bool {
        lock(&self.hub).is_some()
    }

    fn on(
        &self,
        environment: &ComponentEnvironment,
        topic: &ObjectName,
    ) -> Result<Arc<dyn Subscription<C>>, DeliveryError> {
        let topic = environment.feature::<Topics>().topic::<E>(topic.as_str(), self.at)?;
        Ok(Arc::new(TopicSubscription::new(topic, self.only_if.clone(), self.at)))
    }

    fn end(&self, cell: &ComponentCell<C>) {
        if let Some(At { queue, .. }) = lock(&self.hub).take() {
            if queue.is_undecided(self.present.load(Relaxed)) {
                lose_undecided::<C, E>(cell, cell.record.incarnation().0);
            }
            self.present.store(0, Relaxed);
            self.topic.leave(&queue);
            let was_last = self.topic.remove_listener();
            self.topic.listener_changed(&cell.record.name, false, was_last);
        }
    }
}
