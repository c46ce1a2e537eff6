//! Nodes on real threads whose handlers burn time, judged by counts and order, never by speed.

mod groups;
mod hangs;
mod shutdown;
mod stops;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// As long as anything here may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// Two threads that keep two processors until this is dropped.
struct BusyThreads {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl BusyThreads {
    fn start() -> Self {
        let stop = Arc::<AtomicBool>::default();
        let busy = |stop: Arc<AtomicBool>| move || while !stop.load(Relaxed) {};
        let threads = (0..2).map(|_| thread::spawn(busy(stop.clone()))).collect();
        BusyThreads { stop, threads }
    }
}

impl Drop for BusyThreads {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        self.threads.drain(..).for_each(|thread| thread.join().expect("it only spins"));
    }
}
