//! Formats the snapshot of a node as tables.

use comfy_table::{CellAlignment, Table, presets};
use serde_json::Value;
use std::borrow::Cow;
use std::fmt::Write;

/// The tables in their order: the title of each, and its columns by their headings. The key of each
/// in the snapshot is behind `=`, unless it is the same with `_` for spaces.
const TABLES: [&str; 17] = [
    "objects=table: location, kind, incarnation, state, opinion, last sign=last_sign_ms, \
     restarts, suspicions, missed rounds, late p50=late_p50_ms, late p99=late_p99_ms, \
     late max=late_max_ms, queued, oldest=oldest_ms, doing=current, for=current_ms, isolated, \
     note",
    "threads: thread=number, kind, state, by, for=blocked_ms, busy, last beat=last_beat_ms, \
     running, queued, components",
    "networks: network, medium, reach, sealed, insecure",
    "media: network, sent=frames_sent, received=frames_received, dropped=frames_dropped, refused, \
     errors, queued, oldest=oldest_ms",
    "roster: robot, serial, nodes",
    "links: network, link, state, neighbour, last sign=last_sign_ms, round trip=round_trip_ms, \
     jitter=jitter_ms, loss in 1000=loss_permille, cost, sent=frames_sent, bytes sent, \
     received=frames_received, bytes received, B/s sent=bytes_sent_per_s, \
     B/s received=bytes_received_per_s, dropped=frames_dropped, refused, seal, key age=key_age_ms",
    "routes: node, incarnation, network, link, else network=alternate_network, \
     else link=alternate_link, cost, largest frame=mtu_bytes, nodes between=relays",
    "sessions: node, state, incarnation, round trip=round_trip_ms, unacknowledged, in flight, \
     window, queueing=queueing_ms, sent, bytes sent, bytes received, B/s sent=bytes_sent_per_s, \
     B/s received=bytes_received_per_s, retransmitted, duplicates, superseded, replaced, \
     incomplete, returned, refused, differences",
    "forbidden: node, wanted to=verb, object, contract, policy line, times, last=last_ms",
    "global names: name, node, object, epoch, known for=age_ms",
    "services: service=name, state, for=since_ms, standbys=kind, epoch, primary, nodes=members, \
     missing=missing_members, unreplicated, seen before=seen_ms",
    "actuators: object, contract, state, commander, incarnation, epoch, lease left=left_ms",
    "topics: topic, contract, publishers, listeners, publishing nodes, listening nodes, events, \
     in a second=rate_hz, bytes, latched",
    "trees: tree, node=path, type=type_name, depth, answer, called now=called",
    "changes of trees=tree_changes: tree, tick, before=age_ms, changes",
    "dead letters: node, object, contract, reason, times=count",
    "faults: fault=id, code, kind, location, incarnation, times=count, symptom of, \
     found before=age_ms, action, status, service restored before=recovered_ms, \
     part repaired before=repaired_ms, detail",
];

/// The heading and the key of a table or a column.
fn parts(named: &str) -> (&str, Cow<'_, str>) {
    match named.split_once('=') {
        Some((heading, key)) => (heading, key.into()),
        None => (named, named.replace(' ', "_").into()),
    }
}

/// The longest text of a cell. The JSON document has longer texts in full.
pub(crate) const WIDEST: usize = 60;

/// Whether the output shows colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Colour {
    Plain,
    /// By the sequences of ECMA-48, as terminals understand them.
    Ansi,
}

impl Colour {
    fn red(self, line: &str) -> String {
        match self {
            Colour::Plain => line.to_owned(),
            Colour::Ansi => format!("\x1b[31m{line}\x1b[0m"),
        }
    }
}

/// Returns the snapshot as text. An unknown value is a dash. Empty tables are left out; a table of
/// a part that has not answered says so. What is insecure is red.
pub(crate) fn draw(snapshot: &Value, colour: Colour) -> String {
    let mut text =
        format!("{} {}", cell("", &snapshot["node"], WIDEST), cell("", &snapshot["state"], WIDEST));
    if let Some(reason) = snapshot["reason"].as_str() {
        let _ = write!(text, ": {}", plain(reason));
    }
    text.push('\n');
    for network in snapshot["networks"].as_array().into_iter().flatten() {
        if network["insecure"] == true {
            let name = cell("", &network["network"], WIDEST);
            let line = format!("INSECURE: every station on network {name} can command this robot");
            let _ = writeln!(text, "{}", colour.red(&line));
        }
    }
    for described in TABLES {
        let (named, columns) = described.split_once(": ").unwrap_or((described, ""));
        let (title, name) = parts(named);
        if snapshot.get(&*name).is_some_and(Value::is_null) {
            let _ = write!(text, "\n{title}: not answered\n");
        }
        let rows = snapshot[&*name].as_array().map(Vec::as_slice).unwrap_or_default();
        if !rows.is_empty() {
            let _ = writeln!(text, "\n{title}");
            // Each row is one line, below that of the headings.
            let insecure =
                [false].into_iter().chain(rows.iter().map(|row| row["insecure"] == true));
            for (line, insecure) in table(columns, rows, WIDEST).lines().zip(insecure) {
                let shown = if insecure { colour.red(line) } else { line.to_owned() };
                let _ = writeln!(text, "{shown}");
            }
        }
    }
    text
}

/// One table as lines of text, whose cells have at most `widest` characters. The columns are
/// headings with commas between them, each with its key behind `=` where that is another.
pub(crate) fn table(columns: &str, rows: &[Value], widest: usize) -> String {
    let columns: Vec<_> = columns.split(", ").map(parts).collect();
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_header(columns.iter().map(|(heading, _)| *heading));
    for (at, (_, name)) in columns.iter().enumerate() {
        let is_figure = |row: &Value| row[&**name].is_number() || row[&**name].is_null();
        if let Some(column) = table.column_mut(at)
            && rows.iter().all(is_figure)
        {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table.add_rows(
        rows.iter().map(|row| columns.iter().map(|(_, name)| cell(name, &row[&**name], widest))),
    );
    table.trim_fmt() + "\n"
}

/// Replaces control characters: texts also come from other nodes.
fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

fn cell(name: &str, value: &Value, widest: usize) -> String {
    let text = match value {
        Value::Null => "-".to_owned(),
        Value::Bool(yes) => if *yes { "yes" } else { "-" }.to_owned(),
        Value::Number(number) if name.ends_with("_ms") => span(number.as_f64().unwrap_or_default()),
        Value::Number(number) if name == "busy" => {
            format!("{:.0} %", number.as_f64().unwrap_or_default() * 100.0)
        }
        Value::Number(number) if name == "rate_hz" => {
            format!("{:.1}", number.as_f64().unwrap_or_default())
        }
        Value::Number(number) => number.to_string(),
        Value::String(text) => plain(text),
        Value::Array(parts) if parts.is_empty() => "-".to_owned(),
        Value::Array(parts) => {
            parts.iter().map(|part| cell(name, part, widest)).collect::<Vec<_>>().join(", ")
        }
        Value::Object(_) => "…".to_owned(),
    };
    match text.char_indices().nth(widest) {
        Some((at, _)) => format!("{}…", &text[..at]),
        None => text,
    }
}

fn span(millis: f64) -> String {
    match millis {
        millis if millis < 10.0 => format!("{millis:.2} ms"),
        millis if millis < 1_000.0 => format!("{millis:.0} ms"),
        millis => format!("{:.1} s", millis / 1_000.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn each_table_is_aligned_and_what_is_unknown_is_a_dash() {
        let snapshot = json!({
            "node": "module1", "state": "running", "reason": null,
            "global_names": [
                { "name": "map", "node": "module1", "object": "slam", "epoch": 7, "age_ms": 0.25 },
                { "name": "base", "node": null, "object": "b", "epoch": 12, "age_ms": 61000.0 },
            ],
            "threads": [],
            "networks": [
                { "network": "lan", "medium": "udp://10.0.0.1:7400", "reach": "network", "sealed": false, "insecure": true },
                { "network": "wire", "medium": "udp://10.0.1.1:7400", "reach": "network", "sealed": true, "insecure": false },
                { "network": "here", "medium": "memory://a", "reach": "this process", "sealed": false, "insecure": false },
            ],
            "links": [{
                "network": "wire", "link": "wire", "state": "up", "neighbour": "arm", "last_sign_ms": 12.0,
                "round_trip_ms": 0.2, "jitter_ms": 0.01, "loss_permille": 0, "cost": 10,
                "frames_sent": 12, "bytes_sent": 3456, "frames_received": 7, "bytes_received": 890,
                "bytes_sent_per_s": 345, "bytes_received_per_s": 89, "frames_dropped": 1, "refused": 0,
                "seal": "AES-256-GCM", "key_age_ms": 61000.0,
            }],
            "media": [{
                "network": "wire", "frames_sent": 20, "frames_received": 9, "frames_dropped": 2,
                "refused": 0, "errors": 1, "queued": 3, "oldest_ms": 40.0,
            }],
            "routes": [{
                "node": "head", "incarnation": 3, "network": "wire", "link": "wire",
                "alternate_network": null, "alternate_link": null, "cost": 20, "mtu_bytes": 1200, "relays": 1,
            }],
            "roster": [{ "robot": "ranger", "serial": 7, "nodes": 3 }],
            "trees": [{
                "tree": "mission", "path": "left/reach", "type_name": "Reach", "depth": 2,
                "answer": "RUNNING", "called": true,
            }],
            "tree_changes": [{
                "tree": "mission", "tick": 7, "age_ms": 40.0,
                "changes": "left/reach: IDLE -> RUNNING",
            }],
            "dead_letters": [
                { "node": "arm", "object": "grip", "contract": "close", "reason": "no way", "count": 2 },
            ],
            "faults": null,
        });

        let text = "\
module1 running
INSECURE: every station on network lan can command this robot

networks
 network  medium               reach         sealed  insecure
 lan      udp://10.0.0.1:7400  network       -       yes
 wire     udp://10.0.1.1:7400  network       yes     -
 here     memory://a           this process  -       -

media
 network  sent  received  dropped  refused  errors  queued  oldest
 wire       20         9        2        0       1       3   40 ms

roster
 robot   serial  nodes
 ranger       7      3

links
 network  link  state  neighbour  last sign  round trip   jitter  loss in 1000  cost  sent  bytes sent  received  bytes received  B/s sent  B/s received  dropped  refused  seal         key age
 wire     wire  up     arm            12 ms     0.20 ms  0.01 ms             0    10    12        3456         7             890       345            89        1        0  AES-256-GCM   61.0 s

routes
 node  incarnation  network  link  else network  else link  cost  largest frame  nodes between
 head            3  wire     wire             -          -    20           1200              1

global names
 name  node     object  epoch  known for
 map   module1  slam        7    0.25 ms
 base  -        b          12     61.0 s

trees
 tree     node        type   depth  answer   called now
 mission  left/reach  Reach      2  RUNNING  yes

changes of trees
 tree     tick  before  changes
 mission     7   40 ms  left/reach: IDLE -> RUNNING

dead letters
 node  object  contract  reason  times
 arm   grip    close     no way      2

faults: not answered
";
        assert_eq!(draw(&snapshot, Colour::Plain), text);

        let coloured = draw(&snapshot, Colour::Ansi);
        let red: Vec<&str> = coloured.lines().filter(|line| line.starts_with("\x1b[31m")).collect();
        assert!(red.iter().all(|line| line.ends_with("\x1b[0m")), "{red:?}");
        assert!(red[0].contains("INSECURE") && red[1].contains(" lan "), "{red:?}");
        assert_eq!(red.len(), 2, "{red:?}");
        assert_eq!(coloured.replace("\x1b[31m", "").replace("\x1b[0m", ""), text);
    }

    #[test]
    fn long_texts_are_cut_with_a_sign_and_keep_to_one_line() {
        assert_eq!(cell("note", &json!("one\ntwo"), WIDEST), "one two");
        assert_eq!(
            cell("note", &json!("\u{1b}[2Jnothing is cleared"), WIDEST),
            " [2Jnothing is cleared"
        );
        let long = cell("note", &json!("ä".repeat(100)), WIDEST);
        assert_eq!((long.chars().count(), long.ends_with('…')), (WIDEST + 1, true));
        assert_eq!(cell("note", &json!("ä".repeat(100)), usize::MAX), "ä".repeat(100));
        assert_eq!(cell("differences", &json!(["a", "b"]), WIDEST), "a, b");
        assert_eq!(cell("busy", &json!(0.125), WIDEST), "12 %");
    }
}
