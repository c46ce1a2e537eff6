//! What the endpoint strings of Zenoh say.

use super::settings::Settings;
use super::{Endpoint, EndpointError, EndpointProblem, LEAST_BYTES, MOST_BYTES, Parts};
use crate::zenoh::{CHUNK, ZenohConfig, is_chunk};
use std::path::PathBuf;

pub(super) fn parse(
    parts: &Parts<'_>,
    settings: &mut Settings<'_>,
) -> Result<Endpoint, EndpointError> {
    let place = parts.place.rsplit_once('/').unwrap_or((parts.place, ""));
    let (namespace, name) = place;
    if namespace.is_empty() || name.is_empty() {
        let (what, example) = ("the robot, or of our end in it,", "zenoh://ranger/base");
        return Err(parts.error(EndpointProblem::NoName { what, example }));
    }
    if !namespace.split('/').chain([name]).all(is_chunk) {
        return Err(parts.error(EndpointProblem::BadPath { why: CHUNK }));
    }
    let mut config = ZenohConfig::new(namespace, name);
    let expected = "endpoints of Zenoh, as in tcp/10.0.0.1:7447,tls/router.example:7447";
    config.connect = settings.take("connect", expected, endpoints)?.unwrap_or_default();
    config.listen = settings.take("listen", expected, endpoints)?.unwrap_or_default();
    config.file = settings.take("file", "a path, as in /etc/zenoh.json5", |text| {
        text.starts_with('/').then(|| PathBuf::from(text))
    })?;
    // Zenoh cuts up what is larger than its batches of 64 KiB.
    settings.number("mtu", LEAST_BYTES..=MOST_BYTES, &mut config.mtu)?;
    Ok(Endpoint::Zenoh(config))
}

fn endpoints(text: &str) -> Option<Vec<String>> {
    let is_endpoint = |one: &str| {
        let parts = one.split_once('/');
        parts.is_some_and(|(protocol, place)| is_chunk(protocol) && !place.is_empty())
    };
    text.split(',').map(|one| is_endpoint(one).then(|| one.to_owned())).collect()
}
