//! Reads and writes of any length: consecutive elements in as many requests as needed, one after
//! the other. More than one request is a [job](StationJob).
//!
//! Invariants:
//! - Nothing is sent unless all the elements exist, in the framing of the link.
//! - A request begins where the one before it has ended, so no value of 32 bits is split. It is as
//!   long as the protocol and the declared capabilities of the station allow, or one element shorter: the link
//!   chooses, to tell its reply from the one before. Counters of 32 bits are read and written one by
//!   one.
//! - A value that is longer than a request is refused before anything is sent.
//! - The first failure ends the call. A write reports how many elements are confirmed as written.

use super::{JobReply, Outcome, Station, StationJob};
use crate::command::{ArrayVec, Code, Command, Consecutive, InvalidRequest, StackReply, ValueOf, check_range};
use crate::element::{Element, ElementError};
use crate::error::Error;

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
    let most = station.request_lengths().most(first.into());
    if (1..=most).contains(&count) {
        return station.call(request(first, count)?).await;
    }
    // A single request checks its elements when it is made.
    check_range(C::CODE, first.into(), count, station.link.framing())?;
    let mut job = StationJob::new(station);
    let mut values = Vec::with_capacity(count);
    loop {
        while values.len() < count {
            let part = request(nth(first, values.len())?, most.min(count - values.len()))?;
            match job.call(values.len(), part, true).await? {
                Outcome::Reply(JobReply { reply, .. }) => values.extend(reply),
                Outcome::Rewind(confirmed) => values.truncate(confirmed),
            }
        }
        match job.end().await? {
            None => return Ok(values),
            Some(confirmed) => values.truncate(confirmed),
        }
    }
}

/// Fills `into` with elements from `first` on; `request` makes one request, of at most `N`
/// elements.
pub(super) async fn read_into<E, C, const N: usize>(
    station: &Station,
    first: E,
    into: &mut [ValueOf<C>],
    request: impl Fn(E, usize) -> Result<C, InvalidRequest>,
) -> Result<(), Error>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError> + Copy,
    C: Consecutive,
{
    let count = into.len();
    let most = station.request_lengths().most(first.into());
    // The caller copies the values: the link holds no reference to memory of a future that may be
    // dropped.
    let mut copy = |from: usize, values: &[ValueOf<C>]| {
        into.iter_mut().skip(from).zip(values).for_each(|(place, &value)| *place = value);
    };
    if (1..=most).contains(&count) {
        let request = StackReply::<C, N>(request(first, count)?);
        let take = |reply: &mut Option<ArrayVec<_, N>>| {
            copy(0, reply.as_ref()?.as_slice());
            Some(())
        };
        return station.call_with(request, take).await;
    }
    check_range(C::CODE, first.into(), count, station.link.framing())?;
    let mut job = StationJob::new(station);
    let mut read = 0;
    loop {
        while read < count {
            let part = StackReply::<C, N>(request(nth(first, read)?, most.min(count - read))?);
            match job.call(read, part, true).await? {
                Outcome::Reply(JobReply { reply, .. }) => {
                    copy(read, reply.as_slice());
                    read += reply.as_slice().len();
                }
                Outcome::Rewind(confirmed) => read = confirmed,
            }
        }
        match job.end().await? {
            None => return Ok(()),
            Some(confirmed) => read = confirmed,
        }
    }
}

/// Writes `values` to `first` and the elements after it; `request` makes one request. Each `unit` of
/// elements, from the first on, is one value, which no request splits.
pub(super) async fn write<E, T, C>(
    station: &Station,
    (first, unit): (E, usize),
    values: &[T],
    request: impl Fn(E, &[T]) -> Result<C, InvalidRequest>,
) -> Result<(), Error>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError> + Copy,
    C: Command<Reply = ()>,
{
    check_value(station, C::CODE, (first.into(), unit))?;
    let (count, most) = (values.len(), station.request_lengths().most(first.into()));
    let most = most / unit.max(1) * unit;
    if (1..=most).contains(&count) {
        return station.call(request(first, values)?).await;
    }
    check_range(C::CODE, first.into(), count, station.link.framing())?;
    // Writes are not repeated. Those since the last proof have an unknown result, even if none was
    // confirmed.
    let unknown = |written, source: Error| Error::PartlyWritten { written, count, source: Box::new(source) };
    let duplicates = || Error::Duplicates { station: station.number, sent: true };
    let mut job = StationJob::of_writes(station);
    let mut written = 0;
    while let Some(rest) = values.get(written..).filter(|rest| !rest.is_empty()) {
        let part = request(nth(first, written)?, rest.get(..most).unwrap_or(rest))?;
        match job.call(written, part, true).await {
            Ok(Outcome::Reply(JobReply { count, .. })) => written += count,
            Ok(Outcome::Rewind(confirmed)) => return Err(unknown(confirmed, duplicates())),
            Err(error) => return Err(partly(written, count, error)),
        }
    }
    match job.end().await {
        Ok(None) => Ok(()),
        Ok(Some(confirmed)) => Err(unknown(confirmed, duplicates())),
        // All were acknowledged, but not confirmed.
        Err(error) => Err(unknown(job.first_held().unwrap_or(count), error)),
    }
}

/// Checks that one request to the station can have a value of this many elements.
pub(super) fn check_value(
    station: &Station,
    code: Code,
    (first, count): (Element, usize),
) -> Result<(), InvalidRequest> {
    let max = station.request_lengths().most(first);
    if count > max { Err(InvalidRequest::ValueTooLong { code, first, count, max }) } else { Ok(()) }
}

/// The error of a write of `count` values, of which `written` were written before it.
pub(super) fn partly(written: usize, count: usize, error: Error) -> Error {
    if let Error::PartlyWritten { written: more, source, .. } = error {
        return Error::PartlyWritten { written: written + more, count, source };
    }
    if written == 0 { error } else { Error::PartlyWritten { written, count, source: Box::new(error) } }
}

fn nth<E>(first: E, n: usize) -> Result<E, InvalidRequest>
where
    E: Into<Element> + TryFrom<Element, Error = ElementError>,
{
    Ok(first.into().nth(n)?.try_into()?)
}
