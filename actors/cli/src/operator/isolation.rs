//! `blastema node isolate` and `blastema node admit`.

use super::{OperatorKey, OperatorSession};
use crate::args::NodeJob;
use blastema::core::net::trust::policy::Role;

/// Orders all nodes that are reached, and returns whether each has done it.
///
/// # Errors
/// No node was reached, or the command line is wrong.
pub(crate) fn run(job: &NodeJob) -> Result<bool, String> {
    let (NodeJob::Isolate(options) | NodeJob::Admit(options)) = job;
    let isolated = matches!(job, NodeJob::Isolate(_));
    let key = OperatorKey::of(&options.operator)?;
    let node = options.node.as_str();
    if options.via.node == node {
        return Err(format!("{node} does not isolate itself: connect to another node by --via"));
    }
    key.check_listed(node)?;
    let orders = async |session: &OperatorSession| {
        let (mut all_done, mut text) = (true, String::new());
        for to in key.others().filter(|to| to.name.as_str() != node && to.role != Role::Guest) {
            let (name, reason, within) = (to.name.as_str(), &options.reason, session.within);
            let by = &session.node;
            let ordered = match session.reaches(&to.name).await {
                false => None,
                true if isolated => Some(by.order_isolation(name, node, reason, within).await),
                true => Some(by.order_admission(name, node, reason, within).await),
            };
            let outcome = ordered.map_or(Err("not reached".to_owned()), |ordered| {
                ordered.map_err(|error| error.to_string())
            });
            all_done &= outcome.is_ok();
            let done = if isolated { "isolates" } else { "admits" };
            text += &match outcome {
                Ok(()) => format!("{name}: {done} {node}\n"),
                Err(why) => format!("{name}: nothing was changed: {why}\n"),
            };
        }
        Ok((all_done, text))
    };
    let (all_done, text) = OperatorSession::run(&key, &options.via, &options.operator, orders)?;
    crate::print(&text).map(|()| all_done)
}
