//! How many connections there are, in all and from each address.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv6Addr},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use super::Limits;
use crate::metrics::metrics;

/// The part of an IPv6 address that one customer usually has.
const PREFIX: u128 = u128::MAX << 64;

#[derive(Default)]
struct Counts {
    all: usize,
    by_address: HashMap<IpAddr, usize>,
}

/// The places of all connections.
#[derive(Clone, Default)]
pub(super) struct Places(Arc<Mutex<Counts>>);

/// The place of one connection, free again when it is dropped.
pub(super) struct Place {
    places: Places,
    address: IpAddr,
}

impl Places {
    fn lock(&self) -> MutexGuard<'_, Counts> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place for a connection from this address, or the reason why there is none.
    pub(super) fn enter(&self, address: IpAddr, limits: &Limits) -> Result<Place, &'static str> {
        let address = whole(address);
        let mut counts = self.lock();
        if counts.all >= limits.connections {
            return Err("server_full");
        }
        let own = counts.by_address.entry(address).or_default();
        if *own >= limits.per_address {
            return Err("address_full");
        }
        *own += 1;
        counts.all += 1;
        metrics().connection_opened();
        Ok(Place {
            places: self.clone(),
            address,
        })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut counts = self.places.lock();
        counts.all -= 1;
        if let Some(own) = counts.by_address.get_mut(&self.address) {
            *own -= 1;
            if *own == 0 {
                counts.by_address.remove(&self.address);
            }
        }
        metrics().connection_closed();
    }
}

/// What counts as one address.
fn whole(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & PREFIX).into(),
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn places_are_counted_in_all_and_by_address() {
        let places = Places::default();
        let limits = Limits {
            connections: 3,
            per_address: 2,
            handshake: Duration::ZERO,
        };
        let enter = |address: &str| places.enter(address.parse().expect("an address"), &limits);
        let first = enter("192.0.2.1").expect("a place");
        let _second = enter("::ffff:192.0.2.1").expect("a place");
        assert_eq!(enter("192.0.2.1").err(), Some("address_full"));
        let _third = enter("2001:db8::1").expect("a place");
        assert_eq!(enter("2001:db8:1::1").err(), Some("server_full"));
        drop(first);
        let _fourth = enter("2001:db8::2").expect("a place");
        drop(_second);
        assert_eq!(enter("2001:db8::3").err(), Some("address_full"));
    }
}
