//! Naive variants of the protocol, for a test that must see them fail. Only a build with the feature `naive-fleet`
//! has them, and in it `FATEK_FLEET_NAIVE` chooses one. **They give PLCs two masters.**
//!
//! | value | variant |
//! |---|---|
//! | `gate` | no deadline: an owner sends until it sees that it has lost a link |
//! | `fence` | no fence: the links of a silent session are taken, and it may go on |
//! | `ttl` | no member fences: sessions are expired by the server, or by a test in its place |

use std::sync::OnceLock;

use super::bucket::Store;
use super::core::{Operation, Outcome};
use super::keys::{DEAD, Key};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Naive {
    Gate,
    Fence,
    Ttl,
}

/// The variant that was chosen.
fn variant() -> Option<Naive> {
    static VARIANT: OnceLock<Option<Naive>> = OnceLock::new();
    *VARIANT.get_or_init(|| {
        let chosen = std::env::var("FATEK_FLEET_NAIVE").ok()?;
        let variant = match chosen.as_str() {
            "gate" => Naive::Gate,
            "fence" => Naive::Fence,
            "ttl" => Naive::Ttl,
            _ => {
                tracing::error!("FATEK_FLEET_NAIVE is gate, fence or ttl, and not {chosen}");
                return None;
            }
        };
        tracing::error!("FATEK_FLEET_NAIVE={chosen}: this bridge is NOT SAFE. PLCs will have two masters");
        Some(variant)
    })
}

/// Returns whether gates have no deadline.
pub(super) fn has_no_deadline() -> bool {
    variant() == Some(Naive::Gate)
}

/// Returns the outcome of a request in place of the store, if the variant has one for it. `own`: the own session.
pub(super) async fn perform(store: &Store, operation: &Operation, own: Option<&str>) -> Option<Outcome> {
    let Operation::Put { key, value, .. } = operation else { return None };
    let is_fence = value == DEAD && matches!(Key::parse(key), Some(Key::Session(session)) if Some(session) != own);
    match variant().filter(|_| is_fence)? {
        Naive::Gate => None,
        // It is told that it has fenced the session, which nothing was done about.
        Naive::Fence => Some(store.put_always("naive", String::new()).await),
        Naive::Ttl => Some(Outcome::WrongRevision),
    }
}
