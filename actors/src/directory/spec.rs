//! Components that claim names of the whole robot.

use super::ClaimPolicy;
use super::table::DirectoryTable;
use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::declaration::{CellListener, Declarations};
use crate::component::spec_error::SpecError;
use crate::host::spec::ChildSpec;
use crate::settings::SettingError;
use blastema_core::ObjectName;
use blastema_core::directory::ClaimRequest;
use std::collections::BTreeSet;
use std::sync::Arc;

/// The names that a component claims.
#[derive(Default)]
struct ClaimedNames(Vec<(String, ClaimPolicy)>);

impl<C: Component> Declarations<C> for ClaimedNames {
    fn check(&self, component: &ObjectName, _: &BTreeSet<&'static str>) -> Result<(), SpecError> {
        let mut names = BTreeSet::new();
        for (name, _) in &self.0 {
            ObjectName::new(name)?;
            if !names.insert(name) {
                let (value, cure) = (format!("{name} twice"), "claim each name once");
                let error = SettingError { setting: "a claim", value, cure };
                return Err(SpecError::setting(component.as_str(), error));
            }
        }
        Ok(())
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let names = cell.record.environment.feature::<DirectoryTable>().clone();
        let claims = self.0.into_iter().map(|(name, policy)| {
            let (name, object) = (ObjectName::new(&name)?, cell.record.name.clone());
            Ok((ClaimRequest { name, object, policy }, names.number()))
        });
        let claims = claims.collect::<Result<_, SpecError>>()?;
        cell.record.listen(Claims { names, claims });
        Ok(())
    }
}

/// Claims a component's names while it is active. Each claim has a number.
struct Claims {
    names: DirectoryTable,
    claims: Box<[(ClaimRequest, u64)]>,
}

impl CellListener for Claims {
    fn activated(&self) {
        for (wanted, number) in &self.claims {
            drop(self.names.claim(wanted.clone(), *number, true));
        }
    }

    fn deactivated(&self) {
        for (wanted, number) in &self.claims {
            self.names.withdraw(&wanted.name, *number);
        }
    }
}

impl<C: Component> ChildSpec<C> {
    /// Claims a [name of the whole robot](crate::manual::names) whenever an incarnation is at work,
    /// and gives it back when that ends and none follows on the spot. Where another holds it, the
    /// component goes without, which is a fault, or stands by.
    pub fn claim(self, name: &str, policy: ClaimPolicy) -> Self {
        let claimed = (name.to_owned(), policy);
        self.with_ports(move |ports| ports.feature::<ClaimedNames>().0.push(claimed))
    }
}
