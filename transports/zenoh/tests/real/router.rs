//! A router of Zenoh, as a process of its own.

use blastema_tests::addresses;

/// Plays a router at the first address, which keeps a connection with the others, for ever.
pub(crate) fn run() {
    blastema::platform::end_with_parent(std::os::unix::process::parent_id())
        .expect("the parent runs");
    let runtime = tokio::runtime::Runtime::new().expect("there are threads");
    runtime.block_on(async {
        let mut config = zenoh::Config::default();
        let at = addresses();
        let endpoints = |at: &[String]| {
            let at: Vec<_> = at.iter().map(|one| format!("\"tcp/{one}\"")).collect();
            format!("[{}]", at.join(","))
        };
        for (key, value) in [
            ("mode", "\"router\""),
            ("scouting/multicast/enabled", "false"),
            ("listen/endpoints", &endpoints(&at[..1])),
            ("connect/endpoints", &endpoints(&at[1..])),
            ("connect/exit_on_failure", "false"),
            ("connect/retry", r#"{"period_init_ms":50,"period_max_ms":200}"#),
        ] {
            config.insert_json5(key, value).expect("Zenoh has this setting");
        }
        let _router = zenoh::open(config).await.expect("the address is free");
        std::future::pending::<()>().await;
    });
}
