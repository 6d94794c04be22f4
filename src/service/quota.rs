//! Limited number of permits for clients, with a limit per address.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

/// Counter of issued permits; clones share the count.
#[derive(Clone)]
pub struct Quota {
    limit: usize,
    per_address: usize,
    taken: Arc<Mutex<Taken>>,
}

#[derive(Default)]
struct Taken {
    all: usize,
    by_address: HashMap<IpAddr, usize>,
}

/// Permit that is returned when dropped.
pub struct Permit {
    quota: Quota,
    address: IpAddr,
}

impl Quota {
    /// Creates a quota of `limit` permits, with at most `per_address` for one address.
    pub fn new(limit: usize, per_address: usize) -> Quota {
        Quota {
            limit,
            per_address,
            taken: Arc::default(),
        }
    }

    /// Acquires a permit for a client. Returns `None` if either limit is reached.
    pub fn take(&self, address: IpAddr) -> Option<Permit> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let of_address = taken.by_address.get(&address).copied().unwrap_or(0);
        if taken.all >= self.limit || of_address >= self.per_address {
            return None;
        }
        taken.all += 1;
        taken.by_address.insert(address, of_address + 1);
        Some(Permit {
            quota: self.clone(),
            address,
        })
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut taken = self
            .quota
            .taken
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        taken.all -= 1;
        if let Some(count) = taken.by_address.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                taken.by_address.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_limited_for_all_and_for_each_address_and_returned() {
        let quota = Quota::new(5, 3);
        let [one, other] = [1, 2].map(|last| IpAddr::from([10, 0, 0, last]));
        let mut held: Vec<Permit> = (0..3).filter_map(|_| quota.take(one)).collect();
        assert_eq!(held.len(), 3);
        assert!(quota.take(one).is_none(), "limit of the address");
        held.extend((0..2).filter_map(|_| quota.take(other)));
        assert_eq!(held.len(), 5);
        assert!(quota.take(other).is_none(), "limit of all");
        held.clear();
        assert!(quota.take(one).is_some());
        assert!(quota.taken.lock().unwrap().by_address.is_empty());
    }
}
