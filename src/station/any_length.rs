//! Reads and writes of any length: consecutive elements in as many requests as they take, one after the other.
//!
//! What must always hold:
//! - nothing is sent unless all the elements exist;
//! - a request begins where the one before it has ended, and is as long as the protocol allows, so that no value of 32
//!   bits, nor a pair of words that begins at an even distance from the first, is split between two;
//! - the first failure is the end; a write tells how much came before it, and a read into memory of the caller leaves what
//!   lies behind it as it was.

use crate::command::{Command, Consecutive, InPlace, InvalidRequest, check_range, most_in_one_request};
use crate::element::{Element, ElementError};
use crate::error::Error;

use super::Station;

/// Reads `count` elements from `first` on; `request` makes one request.
pub(super) async fn read<E, T, C>(
    station: &Station,
    first: E,
    count: usize,
    request: impl Fn(E, usize) -> Result<C, InvalidRequest>,
) -> Result<Vec<T>, Error>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError> + Copy,
    C: Command<Reply = Vec<T>>,
{
    let most = most_in_one_request(first.into());
    if !(1..=most).contains(&count) {
        // What one request can do is checked when it is made.
        check_range(C::CODE, first.into(), count)?;
    }
    let mut values = station.call(request(first, count.min(most))?).await?;
    while values.len() < count {
        let next = nth(first, values.len())?;
        values.extend(station.call(request(next, most.min(count - values.len()))?).await?);
    }
    Ok(values)
}

/// Reads as many elements from `first` on as there is room for; `request` makes one request, of at most `N`.
pub(super) async fn read_into<E, C, const N: usize>(
    station: &Station,
    first: E,
    into: &mut [C::Value],
    request: impl Fn(E, usize) -> Result<C, InvalidRequest>,
) -> Result<(), Error>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError> + Copy,
    C: Consecutive,
{
    check_range(C::CODE, first.into(), into.len())?;
    let mut read = 0;
    for part in into.chunks_mut(most_in_one_request(first.into())) {
        let request = request(nth(first, read)?, part.len())?;
        // Copied by the caller: the link never has memory that it must give back when a call is dropped.
        let reply = station.call(InPlace::<C, N>(request)).await?;
        part.iter_mut().zip(reply.as_slice()).for_each(|(place, &value)| *place = value);
        read += part.len();
    }
    Ok(())
}

/// Writes these values to `first` and the elements after it; `request` makes one request.
pub(super) async fn write<E, T, C>(
    station: &Station,
    first: E,
    values: &[T],
    request: impl Fn(E, &[T]) -> Result<C, InvalidRequest>,
) -> Result<(), Error>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError> + Copy,
    C: Command<Reply = ()>,
{
    check_range(C::CODE, first.into(), values.len())?;
    let mut written = 0;
    for part in values.chunks(most_in_one_request(first.into())) {
        station.call(request(nth(first, written)?, part)?).await.map_err(|error| match written {
            0 => error,
            written => Error::PartlyWritten { written, count: values.len(), source: Box::new(error) },
        })?;
        written += part.len();
    }
    Ok(())
}

fn nth<E>(first: E, n: usize) -> Result<E, InvalidRequest>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError>,
{
    Ok(first.into().nth(n)?.try_into()?)
}
