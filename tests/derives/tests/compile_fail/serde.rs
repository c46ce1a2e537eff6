use blastema::{Event, Structure};

#[derive(Clone, Structure)]
struct Pose {
    x: f64,
}

#[derive(Clone, Event)]
struct Flat {
    #[serde(flatten)]
    pose: Pose,
}

#[derive(Clone, Event)]
struct Skipped {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pose: Option<Pose>,
}

#[derive(Clone, Event)]
#[serde(untagged)]
enum Untagged {
    Pose(Pose),
}

#[derive(Clone, Event)]
#[serde(rename_all = "camelCase")]
struct Renamed {
    pose: Pose,
}

#[derive(Clone, Structure)]
enum OnVariant {
    #[serde(other)]
    Other,
}

#[derive(Clone, Structure)]
#[serde(deny_unknown_fields)]
struct Denied;

fn main() {}
