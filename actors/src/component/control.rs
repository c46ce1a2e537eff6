//! The commands of the framework to the host of a component.

use crate::platform::lock;
use std::mem::discriminant;
use std::sync::Mutex;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Release};
use std::task::Waker;

/// A command to a host, on the control queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum HostCommand {
    /// End in order.
    Stop,
    /// End in order, because another incarnation follows.
    MakeWay,
    /// Recover from an error.
    Reset,
    /// Return to work, or leave it.
    Activate(bool),
    /// Take the events of subscriptions that were added.
    Attach,
    /// A test has it panic.
    Panic,
}

/// The control queue of one placement of a component: the executor obeys it before it goes on with
/// anything else, also while a handler awaits or a flood of messages waits.
///
/// It holds one command of each kind at most: a later one replaces an earlier one.
#[derive(Debug, Default)]
pub(crate) struct CommandQueue {
    inner: Mutex<Inner>,
    /// Written under the lock, so that the executor does not take it where nothing waits.
    any: AtomicBool,
}

#[derive(Debug, Default)]
struct Inner {
    commands: Vec<HostCommand>,
    /// The executor's, from its first poll to its end.
    waker: Option<Waker>,
}

impl CommandQueue {
    /// Gives the executor a command.
    pub(crate) fn send(&self, command: HostCommand) {
        let mut inner = lock(&self.inner);
        inner.commands.retain(|known| discriminant(known) != discriminant(&command));
        inner.commands.push(command);
        self.any.store(true, Release);
        drop(inner);
        self.wake();
    }

    /// Has the executor look again: something was decided elsewhere.
    pub(crate) fn wake(&self) {
        let waker = lock(&self.inner).waker.clone();
        if let Some(waker) = waker {
            waker.wake();
        }
    }

    /// The task to wake from now on. Set before [`take`](Self::take), so that no command is missed.
    pub(crate) fn set_waker(&self, waker: Option<Waker>) {
        let before = std::mem::replace(&mut lock(&self.inner).waker, waker);
        drop(before);
    }

    /// The commands that have not been obeyed yet, in order.
    #[inline]
    pub(crate) fn take(&self) -> Vec<HostCommand> {
        if self.any.load(Acquire) { self.take_some() } else { Vec::new() }
    }

    #[cold]
    fn take_some(&self) -> Vec<HostCommand> {
        let mut inner = lock(&self.inner);
        self.any.store(false, Release);
        std::mem::take(&mut inner.commands)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_come_in_order_and_the_last_of_each_kind_counts() {
        let queue = CommandQueue::default();
        assert_eq!(queue.take(), []);

        queue.send(HostCommand::Activate(true));
        queue.send(HostCommand::Reset);
        queue.send(HostCommand::Activate(false));

        assert_eq!(queue.take(), [HostCommand::Reset, HostCommand::Activate(false)]);
        assert_eq!(queue.take(), []);
    }
}
