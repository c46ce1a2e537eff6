//! `blastema keys check`: what the nodes of a robot say of their keys.

use crate::args::KeysCheckOptions;
use crate::monitor::tables::{WIDEST, table};
use crate::operator::{OperatorKey, OperatorSession};
use crate::print;
use blastema::KeyStatus;
use blastema::core::net::trust::roster::RosterNode;
use serde_json::{Value, json};

/// Shows the keys of all nodes that the roster lists, and returns whether nothing is wrong.
///
/// # Errors
/// No node was reached, or a file or the command line is wrong.
pub(super) fn run(options: &KeysCheckOptions) -> Result<bool, String> {
    let key = OperatorKey::of(&options.operator)?;
    let ask = async |session: &OperatorSession| {
        let mut answers = Vec::new();
        for listed in key.others() {
            let answer = match session.reaches(&listed.name).await {
                true => {
                    let asked = session.node.key_status_of(listed.name.as_str(), session.within);
                    asked.await.map_err(|error| error.to_string())
                }
                false => Err("it is off, or no path leads to it".to_owned()),
            };
            answers.push((listed, answer));
        }
        Ok(answers)
    };
    let answers = OperatorSession::run(&key, &options.to, &options.operator, ask)?;
    let serials = answers.iter().filter_map(|(_, answer)| Some(answer.as_ref().ok()?.serial));
    let newest = serials.chain([key.roster.serial]).max().expect("there is our own");
    let rows: Vec<_> = answers.iter().map(|(listed, answer)| row(listed, answer, newest)).collect();
    let is_well = rows.iter().all(|row| row["problem"].is_null());
    let robot = key.roster.robot.as_str();
    if options.json {
        let mut nodes = rows;
        for node in nodes.iter_mut().filter_map(Value::as_object_mut) {
            node.remove("shown_networks");
        }
        let document = json!({ "robot": robot, "serial": newest, "well": is_well, "nodes": nodes });
        print(&format!("{document}\n"))?;
    } else {
        let head = format!("robot {robot}, newest roster {newest}\n");
        print(
            &(head
                + &table(
                    "node, roster=serial, fingerprint, networks=shown_networks, problem",
                    &rows,
                    WIDEST,
                )),
        )?;
    }
    Ok(is_well)
}

fn row(listed: &RosterNode, answer: &Result<KeyStatus, String>, newest: u64) -> Value {
    let (node, expected) = (listed.name.as_str(), listed.keys.fingerprint().to_string());
    let status = match answer {
        Ok(status) => status,
        Err(why) => return json!({ "node": node, "reached": false, "problem": why }),
    };
    let seal = |sealed| if sealed { "sealed" } else { "NOT SEALED" };
    let networks = status.networks.iter();
    let shown: Vec<_> =
        networks.clone().map(|on| format!("{} {}", on.network, seal(on.sealed))).collect();
    let open: Vec<_> =
        networks.clone().filter(|on| !on.sealed).map(|on| on.network.as_str()).collect();
    let mut problems = Vec::new();
    if status.serial < newest {
        problems.push(format!("its roster is older than {newest}"));
    }
    if status.fingerprint != expected {
        problems.push(format!("the roster here lists the key {expected}"));
    }
    if !open.is_empty() {
        problems.push(format!("not sealed: {}", open.join(", ")));
    }
    let problem = (!problems.is_empty()).then(|| problems.join("; "));
    let networks: Vec<_> =
        networks.map(|on| json!({ "network": on.network, "sealed": on.sealed })).collect();
    json!({
        "node": node,
        "reached": true,
        "serial": status.serial,
        "fingerprint": status.fingerprint,
        "networks": networks,
        "shown_networks": shown.join(", "),
        "problem": problem,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema::core::NodeName;
    use blastema::core::net::trust::crypto::Seed;
    use blastema::core::net::trust::policy::Role;

    #[test]
    fn what_is_wrong_with_a_node_is_said() {
        let keys = Seed::new([1; 32]).public_keys();
        let name = NodeName::new("arm").expect("a name");
        let listed = RosterNode { name, keys, role: Role::Node };
        let why = "it is off, or no path leads to it".to_owned();

        let row = row(&listed, &Err(why), 3);

        assert_eq!(row["reached"], false);
        assert_eq!(row["problem"], "it is off, or no path leads to it");
    }
}
