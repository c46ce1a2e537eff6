//! An actor in the place of any receiver of a message.

use crate::record::Record;
use actix::prelude::*;
use std::ops::Deref;

/// Receives messages of one type in place of their receiver, records them, and replies.
///
/// # Examples
/// ```
/// use blastema_contract::monitor::IsolationReported;
/// use blastema_core::ObjectName;
/// use blastema_doubles::{Probe, paused};
///
/// paused(async {
///     let monitor = Probe::<IsolationReported>::start();
///     let object = ObjectName::new("laser").unwrap();
///     monitor.recipient().do_send(IsolationReported { object, isolated: true });
///     assert_eq!(monitor.expect().await.object.as_str(), "laser");
/// });
/// ```
pub struct Probe<M>
where
    M: Message + Send + 'static,
    M::Result: Send,
{
    record: Record<M>,
    recipient: Recipient<M>,
}

impl<M> Probe<M>
where
    M: Message + Send + 'static,
    M::Result: Send,
{
    /// A probe on the present arbiter that answers with the default: nothing, zero, `None`.
    pub fn start() -> Self
    where
        M::Result: Default,
    {
        Probe::replying(|_| M::Result::default())
    }

    /// A probe on the present arbiter that answers as the closure says.
    pub fn replying(script: impl FnMut(&M) -> M::Result + 'static) -> Self {
        let record = Record::default();
        let recorder = Recorder { record: record.clone(), script: Box::new(script) };
        Probe { record, recipient: recorder.start().recipient() }
    }

    /// Where to send what is to be recorded.
    pub fn recipient(&self) -> Recipient<M> {
        self.recipient.clone()
    }
}

/// What was received is found in the record.
impl<M> Deref for Probe<M>
where
    M: Message + Send + 'static,
    M::Result: Send,
{
    type Target = Record<M>;

    fn deref(&self) -> &Record<M> {
        &self.record
    }
}

/// What a probe answers to a message.
type Script<M> = Box<dyn FnMut(&M) -> <M as Message>::Result>;

/// The probe's actor.
struct Recorder<M: Message> {
    record: Record<M>,
    script: Script<M>,
}

impl<M: Message + 'static> Actor for Recorder<M> {
    type Context = Context<Self>;
}

impl<M: Message + Send + 'static> Handler<M> for Recorder<M> {
    type Result = MessageResult<M>;

    fn handle(&mut self, message: M, _: &mut Context<Self>) -> MessageResult<M> {
        let reply = (self.script)(&message);
        self.record.push(message);
        MessageResult(reply)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{now, paused};
    use blastema_core::Instant;
    use std::time::Duration;

    #[derive(Debug, PartialEq, Message)]
    #[rtype(result = "u32")]
    struct Double(u32);

    #[test]
    fn a_probe_records_in_order_and_replies_as_told() {
        paused(async {
            let probe = Probe::<Double>::replying(|Double(n)| 2 * n);

            assert_eq!(probe.recipient().send(Double(4)).await.unwrap(), 8);
            assert_eq!(probe.recipient().send(Double(5)).await.unwrap(), 10);

            assert_eq!(probe.len(), 2);
            assert_eq!(probe.expect().await, Double(4));
            assert_eq!(probe.drain(), [Double(5)]);
        });
    }

    #[test]
    fn waiting_skips_what_is_not_wanted() {
        paused(async {
            let probe = Probe::<Double>::start();
            (0..9).for_each(|n| probe.recipient().do_send(Double(n)));

            assert_eq!(probe.wait(|Double(n)| *n == 7).await, Double(7));
            assert_eq!(probe.expect().await, Double(8));
            probe.expect_none_for(Duration::from_secs(60)).await;
            assert_eq!(now(), Instant::from_millis(60_000));
        });
    }

    #[test]
    #[should_panic(expected = "came where none should")]
    fn a_message_where_none_should_be_fails_the_test() {
        paused(async {
            let probe = Probe::<Double>::start();
            probe.recipient().do_send(Double(1));

            probe.expect_none_for(Duration::from_secs(1)).await;
        });
    }

    #[test]
    #[should_panic(expected = "Double came within")]
    fn a_message_that_never_comes_fails_the_test() {
        paused(async {
            let _ = Probe::<Double>::start().expect().await;
        });
    }
}
