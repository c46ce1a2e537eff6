//! Plain keys of Zenoh, for clients that know nothing of Blastema.
//!
//! ```text
//!   put ─► queue of the key ─► session ─► <namespace>/<key>            written keys
//!   reader ◄─ session's callback ◄─────── <namespace>/<key>            read keys
//!                     answers ◄────────── <namespace>/<key>/@schema    of both
//!                     answers ◄────────── <namespace>/<key>            latched keys
//! ```
//!
//! * A chunk that begins with `@` is matched by no wildcard (Zenoh calls it verbatim): who
//!   subscribes to `robot/**` gets no schemas, and who asks for `robot/**/@schema` gets them all.
//! * What is put waits in a bounded queue of its key; when that is full the oldest goes.
//! * While no router is there, nothing is kept for later but the last value of a latched key, which
//!   is put again when the connection is back.

use crate::ends::{CHUNK, Ends, is_chunk, on_own_thread, unopened};
use bytes::Bytes;
use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{Notify, watch};
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::qos::CongestionControl;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session, Wait};

/// So many texts of one key may wait for Zenoh, and so many bytes; one may always.
const WAITING_MAX: usize = 16;
const WAITING_BYTES_MAX: usize = 4 << 20;
/// How often it is looked whether a router is there.
const LOOK_EVERY: Duration = Duration::from_millis(250);
/// The last part of the key at which a schema is asked for.
const SCHEMA: &str = "@schema";

/// Refuses a namespace and keys that are none of Zenoh's, and a session that would be alone.
pub(crate) fn objection<'a>(
    namespace: &str,
    ends: &Ends,
    keys: impl IntoIterator<Item = &'a str>,
) -> Option<String> {
    let wrong = |key: &str| {
        let is_key = key.split('/').all(is_chunk);
        (!is_key).then(|| format!("{key:?} is no key of Zenoh: {CHUNK}, in parts between `/`"))
    };
    if let Some(why) = wrong(namespace) {
        return Some(why);
    }
    let mut known = Vec::new();
    for key in keys {
        if let Some(why) = wrong(key) {
            return Some(why);
        }
        if known.contains(&key) {
            return Some(format!("the key {key:?} is used twice: give each topic one of its own"));
        }
        known.push(key);
    }
    ends.objection()
}

/// One key, and what it is for.
pub(crate) struct ZenohKey {
    /// The key, below the namespace.
    pub(crate) key: String,
    /// The encoding that samples carry, as in `application/json;demo/pose@1`.
    pub(crate) encoding: String,
    /// What is answered to those who ask for the schema: JSON.
    pub(crate) schema: Bytes,
    /// Whether it is written or read.
    pub(crate) used: ZenohKeyUse,
}

/// What a key is for.
pub(crate) enum ZenohKeyUse {
    /// This client writes it.
    Written {
        /// The last value is kept, and answered to those who ask for the key.
        latched: bool,
        /// A value waits, for a bounded time, where Zenoh has no capacity for it; else it is lost.
        waits: bool,
    },
    /// Others write it.
    Read(Arc<dyn ZenohReader>),
}

/// Takes what others write to a key. It is called on a thread of Zenoh's.
pub(crate) trait ZenohReader: Send + Sync {
    /// The most bytes that are taken.
    fn limit(&self) -> usize;
    /// Takes one value. `schema` is what its encoding says after a `;`, if anything.
    fn receive(&self, schema: &str, value: &[u8]);
    /// A value was larger than the limit, or was the deletion of the key, which has no size.
    fn refuse(&self, size: Option<usize>);
}

/// How the client is connected.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum ZenohState {
    /// It is not open.
    Closed,
    /// The session is being opened.
    Opening,
    /// It could not be opened: why, and what to do.
    Failed(String),
    /// A router, or another client, is there.
    Connected,
    /// None is there any more. It connects again by itself.
    Lost,
}

/// Why a value was not put.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PutError {
    /// There is no connection now.
    NotConnected,
}

/// A client of Zenoh with a fixed set of plain keys.
pub(crate) struct ZenohClient {
    namespace: String,
    ends: Ends,
    keys: Vec<ZenohKey>,
    waiting: Vec<Mutex<Waiting>>,
    more: Notify,
    state: watch::Sender<ZenohState>,
    session: Mutex<Option<Arc<Notify>>>,
}

/// Keeps a session open until it is dropped.
#[must_use = "the session is closed when this is dropped"]
#[derive(Debug)]
pub(crate) struct ZenohOpened {
    client: Arc<ZenohClient>,
    closed: Arc<Notify>,
}

impl Drop for ZenohOpened {
    fn drop(&mut self) {
        self.client.close(&self.closed);
    }
}

/// What waits at one key.
#[derive(Default)]
struct Waiting {
    values: VecDeque<Bytes>,
    bytes: usize,
    lost: u64,
    last: Option<Bytes>,
}

impl Waiting {
    fn push(&mut self, value: Bytes) {
        self.bytes += value.len();
        self.values.push_back(value);
        while self.values.len() > WAITING_MAX
            || self.values.len() > 1 && self.bytes > WAITING_BYTES_MAX
        {
            self.pop();
            self.lost += 1;
        }
    }

    fn pop(&mut self) -> Option<Bytes> {
        let value = self.values.pop_front()?;
        self.bytes -= value.len();
        Some(value)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl fmt::Debug for ZenohClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "zenoh {} with {} keys", self.namespace, self.keys.len())
    }
}

impl ZenohClient {
    /// A client that is not open yet.
    pub(crate) fn new(namespace: String, ends: Ends, keys: Vec<ZenohKey>) -> Arc<Self> {
        let waiting = keys.iter().map(|_| Mutex::default()).collect();
        let (more, state) = (Notify::new(), watch::channel(ZenohState::Closed).0);
        let session = Mutex::default();
        Arc::new(ZenohClient { namespace, ends, keys, waiting, more, state, session })
    }

    /// Follows how it is connected.
    pub(crate) fn state(&self) -> watch::Receiver<ZenohState> {
        self.state.subscribe()
    }

    /// How it is connected now.
    pub(crate) fn present_state(&self) -> ZenohState {
        self.state.borrow().clone()
    }

    /// Where it connects and listens, for display.
    pub(crate) fn places(&self) -> String {
        self.ends.places()
    }

    /// Opens the session, and closes the one before. What comes of it, the state tells.
    ///
    /// # Errors
    /// The configuration is refused, or there is no thread to be had.
    pub(crate) fn open(self: &Arc<Self>) -> io::Result<ZenohOpened> {
        let config = self.ends.to_zenoh().map_err(io::Error::other)?;
        let closed = Arc::new(Notify::new());
        let mut session = lock(&self.session);
        if let Some(before) = session.replace(closed.clone()) {
            before.notify_one();
        }
        self.state.send_replace(ZenohState::Opening);
        drop(session);
        let opened = ZenohOpened { client: self.clone(), closed: closed.clone() };
        let (client, failed, own) = (self.clone(), self.clone(), closed.clone());
        on_own_thread(
            move || async move { client.run(config, &closed).await },
            move |why| failed.change(&own, ZenohState::Failed(why)),
        )?;
        Ok(opened)
    }

    /// Closes a session, if no other has taken its place. Values that wait are dropped.
    fn close(&self, closed: &Arc<Notify>) {
        closed.notify_one();
        let mut session = lock(&self.session);
        if session.take_if(|present| Arc::ptr_eq(present, closed)).is_none() {
            return;
        }
        self.state.send_replace(ZenohState::Closed);
        for waiting in &self.waiting {
            let mut waiting = lock(waiting);
            while waiting.pop().is_some() {}
        }
    }

    /// Puts a value to the key of this number, and says how many earlier ones of that key were lost
    /// since the last call, because there was no capacity for them.
    ///
    /// # Errors
    /// [`PutError`]; a latched key keeps the value nevertheless.
    pub(crate) fn put(&self, key: usize, value: Bytes) -> Result<u64, PutError> {
        let mut waiting = lock(&self.waiting[key]);
        if self.is_latched(key) {
            waiting.last = Some(value.clone());
        }
        if *self.state.borrow() != ZenohState::Connected {
            return Err(PutError::NotConnected);
        }
        waiting.push(value);
        let lost = std::mem::take(&mut waiting.lost);
        drop(waiting);
        self.more.notify_one();
        Ok(lost)
    }

    fn is_latched(&self, key: usize) -> bool {
        matches!(self.keys[key].used, ZenohKeyUse::Written { latched: true, .. })
    }

    fn whole(&self, key: usize) -> String {
        format!("{}/{}", self.namespace, self.keys[key].key)
    }

    /// Changes the state, unless another session has taken the place of this one.
    fn change(&self, own: &Arc<Notify>, state: ZenohState) {
        let session = lock(&self.session);
        if session.as_ref().is_some_and(|present| Arc::ptr_eq(present, own)) {
            self.state.send_if_modified(|known| std::mem::replace(known, state.clone()) != state);
        }
    }

    /// What the thread of Zenoh does, until the session is closed.
    async fn run(self: Arc<Self>, config: Config, closed: &Arc<Notify>) {
        let opened = async {
            let session = zenoh::open(config).await?;
            for key in 0..self.keys.len() {
                self.declare(&session, key).await?;
            }
            Ok::<Session, zenoh::Error>(session)
        };
        let session = tokio::select! {
            opened = opened => opened,
            () = closed.notified() => return,
        };
        let session = match session {
            Ok(session) => session,
            Err(error) => return self.change(closed, ZenohState::Failed(unopened(&error))),
        };
        tokio::select! {
            () = self.look(&session, closed) => {}
            () = self.send(&session) => {}
            () = closed.notified() => {}
        }
        // What fails here is over all the same.
        let _ = session.close().await;
    }

    /// What is declared lasts as long as the session.
    async fn declare(self: &Arc<Self>, session: &Session, number: usize) -> zenoh::Result<()> {
        let key = self.whole(number);
        if let ZenohKeyUse::Read(reader) = &self.keys[number].used {
            let reader = reader.clone();
            let receive = move |sample: Sample| receive(&*reader, &sample);
            session.declare_subscriber(&key).callback(receive).background().await?;
        }
        if self.is_latched(number) {
            let client = self.clone();
            let answer = move |query: Query| {
                let last = lock(&client.waiting[number]).last.clone();
                if let Some(last) = last {
                    reply(&query, client.whole(number), last, &client.keys[number].encoding);
                }
            };
            session.declare_queryable(&key).complete(true).callback(answer).background().await?;
        }
        let (client, at) = (self.clone(), format!("{key}/{SCHEMA}"));
        let answer = {
            let at = at.clone();
            move |query: Query| {
                let schema = client.keys[number].schema.clone();
                reply(&query, at.clone(), schema, "application/json");
            }
        };
        session.declare_queryable(at).complete(true).callback(answer).background().await
    }

    /// Looks whether a router or a peer is at the other end, for ever.
    async fn look(&self, session: &Session, own: &Arc<Notify>) {
        let mut was_connected = false;
        loop {
            let info = session.info();
            // Who only listens waits for others; who reads a file may do either.
            let is_connected = self.ends.connect.is_empty()
                || info.routers_zid().await.next().is_some()
                || info.peers_zid().await.next().is_some();
            let state = if is_connected { ZenohState::Connected } else { ZenohState::Lost };
            self.change(own, state);
            if is_connected && !was_connected {
                self.put_latched();
            }
            was_connected = is_connected;
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }

    /// Those at the other end may have missed them.
    fn put_latched(&self) {
        for waiting in &self.waiting {
            let mut waiting = lock(waiting);
            if let Some(last) = waiting.last.clone().filter(|_| waiting.values.is_empty()) {
                waiting.push(last);
            }
        }
        self.more.notify_one();
    }

    /// Hands to Zenoh what waits, one value of each key in turn, for ever.
    async fn send(&self, session: &Session) {
        loop {
            let mut is_idle = true;
            for (number, key) in self.keys.iter().enumerate() {
                let ZenohKeyUse::Written { waits, .. } = key.used else { continue };
                let Some(value) = lock(&self.waiting[number]).pop() else { continue };
                is_idle = false;
                let put = session
                    .put(self.whole(number), ZBytes::from(value))
                    .encoding(Encoding::from(key.encoding.as_str()))
                    .congestion_control(match waits {
                        true => CongestionControl::Block,
                        false => CongestionControl::Drop,
                    });
                if put.await.is_err() {
                    lock(&self.waiting[number]).lost += 1;
                }
            }
            if is_idle {
                self.more.notified().await;
            }
        }
    }
}

fn receive(reader: &dyn ZenohReader, sample: &Sample) {
    if sample.kind() == SampleKind::Delete {
        return reader.refuse(None);
    }
    let size = sample.payload().len();
    if size > reader.limit() {
        return reader.refuse(Some(size));
    }
    let encoding = sample.encoding().to_string();
    let schema = encoding.split_once(';').map_or("", |(_, schema)| schema);
    reader.receive(schema, &sample.payload().to_bytes());
}

fn reply(query: &Query, key: String, value: Bytes, encoding: &str) {
    // Who asked may have gone.
    let _ = query.reply(key, ZBytes::from(value)).encoding(Encoding::from(encoding)).wait();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_parts_without_wildcards_each_used_once() {
        let objects = |(namespace, ends): (&str, &Ends), keys: &[&str], what: &str| {
            let why = objection(namespace, ends, keys.iter().copied()).unwrap_or_default();
            assert!(why.contains(what) && why.is_empty() == what.is_empty(), "{why}");
        };
        objects(("fleet/ranger", &Ends::default()), &["pose"], "add `.connect(");
        let ends = Ends { connect: vec!["tcp/127.0.0.1:7447".into()], ..Ends::default() };
        let config = ("fleet/ranger", &ends);
        objects(config, &["pose", "arm/left/pose"], "");
        objects(config, &["arm/*"], "letters");
        objects(config, &["@schema"], "letters");
        objects(config, &["arm//pose"], "letters");
        objects(config, &["pose", "goal", "pose"], "used twice");
        objects(("pose", &ends), &["pose"], "");
        objects(("", &ends), &["pose"], "letters");
    }

    #[test]
    fn what_waits_is_bounded_and_the_oldest_goes_first() {
        let mut waiting = Waiting::default();
        for number in 0..WAITING_MAX + 3 {
            waiting.push(vec![u8::try_from(number).unwrap()].into());
        }
        assert_eq!((waiting.values.len(), waiting.lost), (WAITING_MAX, 3));
        assert_eq!(waiting.pop().unwrap()[0], 3);

        for _ in 0..3 {
            waiting.push(vec![0; WAITING_BYTES_MAX].into());
        }
        assert_eq!((waiting.values.len(), waiting.bytes), (1, WAITING_BYTES_MAX));
    }

    #[test]
    fn nothing_is_put_without_a_connection_and_a_latched_value_is_kept() {
        let key = |latched| ZenohKey {
            key: "pose".into(),
            encoding: "application/json".into(),
            schema: Bytes::new(),
            used: ZenohKeyUse::Written { latched, waits: true },
        };
        let client =
            ZenohClient::new("ranger".into(), Ends::default(), vec![key(true), key(false)]);
        for number in [0, 1] {
            assert_eq!(client.put(number, vec![1].into()), Err(PutError::NotConnected));
        }
        let kept = |number: usize| lock(&client.waiting[number]).last.is_some();
        assert!(kept(0) && !kept(1));
    }
}
