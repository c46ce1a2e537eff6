//! Where a session of Zenoh connects and listens, and the thread that it runs on.

use std::io;
use std::path::PathBuf;
use zenoh::Config;

/// What a part of a key may be.
pub(crate) const CHUNK: &str = "names have letters, digits, `-`, `_` and `.`";

/// Whether a text is one part of a key.
pub(crate) fn is_chunk(text: &str) -> bool {
    let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    !text.is_empty() && text.len() <= 128 && text.bytes().all(is_allowed)
}

/// The places of one session.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ends {
    /// The routers, or other sessions, as Zenoh writes them: `tcp/10.0.0.1:7447`. One that listens
    /// nowhere uses the first that answers.
    pub(crate) connect: Vec<String>,
    /// Where it listens itself, for sessions without a router.
    pub(crate) listen: Vec<String>,
    /// A configuration of Zenoh in JSON5 or YAML, for all else.
    pub(crate) file: Option<PathBuf>,
}

impl Ends {
    /// Why the session would meet no other, and what to write.
    pub(crate) fn objection(&self) -> Option<String> {
        let is_alone = self.connect.is_empty() && self.listen.is_empty() && self.file.is_none();
        is_alone.then(|| "it connects to no router: add `.connect(\"tcp/ADDRESS:7447\")`".into())
    }

    /// All of them, for display.
    pub(crate) fn places(&self) -> String {
        let file = self.file.iter().map(|file| file.display().to_string());
        let places: Vec<_> = self.connect.iter().chain(&self.listen).cloned().chain(file).collect();
        places.join(", ")
    }

    /// The configuration of a session that meets only whom it is told of.
    pub(crate) fn to_zenoh(&self) -> Result<Config, String> {
        let mut config = match &self.file {
            Some(file) => Config::from_file(file).map_err(|error| error.to_string())?,
            None => Config::default(),
        };
        let list = |all: &[String]| {
            let all: Vec<_> = all.iter().map(|one| format!("{one:?}")).collect();
            format!("[{}]", all.join(","))
        };
        let mut settings = vec![
            // Who is not described is not looked for.
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
            // It cannot be opened while nothing answers, and then connects again by itself.
            ("connect/timeout_ms", "2000".to_owned()),
            ("connect/exit_on_failure", (!self.connect.is_empty()).to_string()),
            ("listen/exit_on_failure", "true".to_owned()),
            ("connect/retry", r#"{"period_init_ms":100,"period_max_ms":1000}"#.to_owned()),
        ];
        if self.file.is_none() {
            let mode = if self.listen.is_empty() { r#""client""# } else { r#""peer""# };
            settings.push(("mode", mode.to_owned()));
        }
        if !self.connect.is_empty() {
            settings.push(("connect/endpoints", list(&self.connect)));
        }
        if !self.listen.is_empty() || self.file.is_none() {
            settings.push(("listen/endpoints", list(&self.listen)));
        }
        for (key, value) in settings {
            config.insert_json5(key, &value).map_err(|error| format!("{key}: {error}"))?;
        }
        Ok(config)
    }
}

/// Runs what a session needs on a thread and a runtime of its own, until it is done.
pub(crate) fn on_own_thread<F: Future<Output = ()>>(
    run: impl FnOnce() -> F + Send + 'static,
    fail: impl FnOnce(String) + Send + 'static,
) -> io::Result<()> {
    let thread = std::thread::Builder::new().name("blastema-zenoh".to_owned());
    thread.spawn(move || {
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        let runtime = match builder.worker_threads(1).enable_all().build() {
            Ok(runtime) => runtime,
            Err(error) => return fail(format!("no runtime: {error}")),
        };
        runtime.block_on(run());
        // Zenoh's own tasks may be in the middle of something that blocks.
        runtime.shutdown_background();
    })?;
    Ok(())
}

/// Why a session could not be opened, and what to look at. Zenoh's errors end with the line of its
/// source, which tells a user nothing.
pub(crate) fn unopened(error: &zenoh::Error) -> String {
    format!("{}: is the router running, and reachable?", without_source(&error.to_string()))
}

fn without_source(error: &str) -> String {
    let is_source = |at: &usize| error[*at..].contains(".rs:");
    let source = error.find(" at /").filter(is_source).unwrap_or(error.len());
    error[..source].trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_of_zenoh_is_shown_without_the_line_of_its_source() {
        let error = "Unable to connect. Timeout! at /root/zenoh-1.10.2/src/orchestrator.rs:388.";
        assert_eq!(without_source(error), "Unable to connect. Timeout!");
        assert_eq!(without_source("no tls at all."), "no tls at all");
    }
}
