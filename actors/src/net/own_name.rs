//! That another process has this node's name, and answers: this one stops.

use tokio::sync::watch;
use tracing::error;

/// Why this node must stop, once it is known. Clones are the same.
#[derive(Clone)]
pub(crate) struct OwnName(watch::Sender<Option<String>>);

impl OwnName {
    pub(super) fn new() -> Self {
        OwnName(watch::Sender::new(None))
    }

    /// Another process has the name. The first reason stays.
    pub(super) fn set_taken(&self, why: String) {
        self.0.send_if_modified(|taken| {
            let is_first = taken.is_none();
            if is_first {
                error!("{why}");
                *taken = Some(why);
            }
            is_first
        });
    }

    /// Why the node must stop; `None` while no other process has its name.
    pub(crate) fn taken(&self) -> Option<String> {
        self.0.borrow().clone()
    }

    /// Resolves with the reason when another process has the name.
    pub(crate) async fn until_taken(&self) -> String {
        let mut taken = self.0.subscribe();
        let why = taken.wait_for(Option::is_some).await;
        why.ok().and_then(|why| why.clone()).expect("this is a sender of it")
    }
}
