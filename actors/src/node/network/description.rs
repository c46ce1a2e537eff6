//! What the description of a node says of other nodes.

use super::Network;
use super::checks::check_networks;
use super::file::NetworkFile;
use crate::net::keys::NodeKeys;
use crate::node::error::StartError;
use crate::platform;
use crate::service::{Carried, ServiceSpecError};
use crate::settings::network::SESSION_TIMEOUT;
use blastema_core::{Incarnation, NodeName};
use std::env;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// The networks of a node, and what it does by way of them.
pub(in crate::node) struct NetworkDescription {
    pub(in crate::node) networks: Vec<Network>,
    pub(in crate::node) file: NetworkFile,
    pub(in crate::node) services: Vec<Result<Carried, ServiceSpecError>>,
    pub(in crate::node) session_timeout: Duration,
    /// The file of the node's key.
    pub(in crate::node) key_file: Option<PathBuf>,
    /// What that file and the roster beside it say, once they are read.
    pub(in crate::node) keys: Option<Arc<NodeKeys>>,
}

/// Names the file of the node's key where the program names none.
const KEYS_VARIABLE: &str = "BLASTEMA_KEYS";

impl Default for NetworkDescription {
    fn default() -> Self {
        NetworkDescription {
            networks: Vec::new(),
            file: NetworkFile::default(),
            services: Vec::new(),
            session_timeout: SESSION_TIMEOUT.default,
            key_file: None,
            keys: None,
        }
    }
}

impl NetworkDescription {
    /// Reads the keys, and finds what can be known to be wrong before anything is started.
    pub(in crate::node) fn check(&mut self, node: &NodeName) -> Result<(), StartError> {
        SESSION_TIMEOUT.check(self.session_timeout)?;
        self.read_file()?;
        self.read_keys(node)?;
        check_networks(&self.networks, node, self.keys.as_deref())
    }

    /// The incarnation of the node that starts now.
    pub(in crate::node) fn begin_incarnation(&self) -> Incarnation {
        let keys = self.keys.as_ref();
        keys.map_or_else(platform::node_incarnation, |keys| keys.begin_incarnation())
    }

    /// What the file describes counts as what is described in code.
    fn read_file(&mut self) -> Result<(), StartError> {
        let Some(mut described) = self.file.read()? else { return Ok(()) };
        self.key_file = self.key_file.take().or(described.keys.take());
        self.networks.extend(described.into_networks());
        Ok(())
    }

    fn read_keys(&mut self, node: &NodeName) -> Result<(), StartError> {
        let found = || {
            let leaves_process = self.networks.iter().any(Network::leaves_process);
            env::var_os(KEYS_VARIABLE).filter(|path| leaves_process && !path.is_empty())
        };
        let (file, named_by) = match (self.key_file.clone(), found()) {
            (Some(file), _) => (file, String::new()),
            (None, Some(file)) => (file.into(), format!("{KEYS_VARIABLE}: ")),
            (None, None) => return Ok(()),
        };
        // The roster is read again and again, and the working directory may change.
        let file = std::path::absolute(&file).unwrap_or(file);
        platform::random_bytes().map_err(|error| {
            StartError::Keys(format!("the system gives no random numbers (getrandom: {error})"))
        })?;
        let keys = NodeKeys::read(&file, node);
        let keys = keys.map_err(|error| StartError::Keys(format!("{named_by}{error}")))?;
        self.keys = Some(Arc::new(keys));
        Ok(())
    }
}
