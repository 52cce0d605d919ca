//! Reading what goes into a backup.

use std::fmt;
use std::time::{Duration, SystemTime};

use tokio::time::Instant;

use super::block::{Chunk, Chunks, runs};
use super::held::Held;
use super::{Backup, BackupError, InvalidBackup, Missing, Origin};
use crate::command::{DetailedStatus, ReadDiscretes, ReadRegisters, Value};
use crate::element::{Element, Width};
use crate::error::Error;
use crate::progress::{Meter, Phase, Progress};
use crate::station::{JobReply, Outcome, Station, StationJob};
use crate::tag::Tag;

pub(super) type OnProgress = Box<dyn FnMut(&Progress) + Send>;

/// The reading of a backup that can be broken off and gone on with.
///
/// It keeps what has been read when a run fails or is dropped, and goes on with the same station alone.
///
/// ```
/// # fatek::sim::doctest(|station| async move {
/// use fatek::backup::TakeBackup;
///
/// let mut taking = TakeBackup::new(["R0-R3839".parse()?])?.on_progress(|progress| eprintln!("{progress}"));
/// let backup = loop {
///     match taking.run(&station).await {
///         Ok(backup) => break backup,
///         Err(error) if taking.partial().value_count() > 0 => eprintln!("{error}; going on"),
///         Err(error) => return Err(error.into()),
///     }
/// };
/// # assert_eq!(backup.value_count(), 3840);
/// # Ok(()) });
/// ```
#[must_use]
pub struct TakeBackup {
    backup: Backup,
    held: Held,
    on_progress: Option<OnProgress>,
}

impl TakeBackup {
    /// Nothing has been read yet.
    ///
    /// # Errors
    /// As for [`Backup::of`].
    pub fn new(ranges: impl IntoIterator<Item = Tag>) -> Result<Self, InvalidBackup> {
        Ok(Self::resume(Backup::of(ranges)?))
    }

    /// Goes on with a backup: what is [`Missing::NotRead`] in it is to be read, from the station that the rest has come from.
    pub fn resume(partial: Backup) -> Self {
        Self { backup: partial, held: Held::default(), on_progress: None }
    }

    /// Called after each request; the steps are elements. It must not take long: the PLC waits meanwhile.
    pub fn on_progress(mut self, tell: impl FnMut(&Progress) + Send + 'static) -> Self {
        self.on_progress = Some(Box::new(tell));
        self
    }

    /// What has been read and confirmed so far. The rest is [`Missing::NotRead`]; of a run that was broken off, that may be the
    /// values of its last 32 requests.
    #[must_use]
    pub fn partial(&self) -> &Backup {
        &self.backup
    }

    /// Reads what has not been read, and gives the backup. What the PLC refuses to give is missing in it, and no failure.
    ///
    /// Each request is a read of its own, with the timeouts and retries of the station's [options](Station::options). A check
    /// (4E) after every 32 requests and in the end confirms that no reply was a duplicate out of order; if one was, those since
    /// the last check are read again, as often as reads are retried. The future can be dropped at any time.
    ///
    /// # Errors
    /// [`BackupError::Call`] when a request fails and it is no refusal: no answer, no connection. Run it again to go on.
    /// [`BackupError::OtherStation`] and [`BackupError::OtherPlc`] when a part has been read from a station of another number, or
    /// from a PLC whose status (53) tells of another main unit or number of I/O points.
    pub async fn run(&mut self, station: &Station) -> Result<Backup, BackupError> {
        match self.backup.station() {
            None => self.look(station).await.map_err(|error| self.failed(error))?,
            Some(_) => self.look_again(station).await?,
        }
        let blocks = self.backup.blocks.iter().enumerate();
        let mut chunks = Chunks::new(blocks.flat_map(|(number, block)| {
            let unread = runs(&block.cells, |cell| *cell == Err(Missing::NotRead));
            unread.into_iter().map(move |run| (number, block.range, run))
        }));
        let (total, mut done) = (self.backup.element_count(), self.done());
        let mut meter = Meter::new(Phase::Reading, total, done, Instant::now());
        let mut job = StationJob::new(station);
        self.held.begin();
        loop {
            let Some(chunk) = chunks.next().filter(|_| !self.held.is_full()) else {
                match job.confirm().await {
                    Ok(None) => {
                        self.keep(None);
                        self.held.checked();
                        if chunks.next().is_none() {
                            return Ok(self.backup.clone());
                        }
                    }
                    Ok(Some(mark)) => done = done.saturating_sub(again(&mut chunks, self.held.rewind(mark))),
                    Err(error) => return Err(self.failed(error)),
                }
                continue;
            };
            let bytes = match fetch(&mut job, self.held.mark(), chunk, true).await {
                Ok(Outcome::Reply(JobReply { reply: values, .. })) => {
                    let count = values.len().min(chunk.count);
                    self.held.hold(Chunk { count, ..chunk }, values);
                    self.keep(job.first_held());
                    chunks.done_first(count);
                    done = done.saturating_add(count);
                    content_len(chunk.range, count)
                }
                Ok(Outcome::Rewind(mark)) => {
                    done = done.saturating_sub(again(&mut chunks, self.held.rewind(mark)));
                    0
                }
                // With the refusal all before it is confirmed.
                Err(Error::Plc { error, .. }) => {
                    self.keep(None);
                    if let Some(single) = chunks.refused() {
                        if let Some(block) = self.backup.blocks.get_mut(single.block) {
                            block.refuse(single, error);
                        }
                        done = done.saturating_add(single.count);
                    }
                    0
                }
                Err(error) => {
                    self.keep(job.first_held());
                    // What was read before is kept if the PLC still confirms it.
                    let duplicates = matches!(error, Error::Duplicates { .. });
                    if !duplicates && matches!(job.confirm().await, Ok(None)) {
                        self.keep(None);
                    }
                    return Err(self.failed(error));
                }
            };
            if let Some(tell) = &mut self.on_progress {
                meter.advance(done, total, bytes);
                tell(&meter.progress(Instant::now()));
            }
        }
    }

    /// Keeps the values that are confirmed: those before this mark; `None`: all.
    fn keep(&mut self, first_held: Option<usize>) {
        for (chunk, values) in self.held.confirmed(first_held) {
            if let Some(block) = self.backup.blocks.get_mut(chunk.block) {
                block.fill(chunk, &values);
            }
        }
    }

    /// Asks the PLC what it is.
    async fn look(&mut self, station: &Station) -> Result<(), Error> {
        let origin = &mut self.backup.origin;
        let read_at = whole_seconds(SystemTime::now());
        let brief = known(station.read_status().await)?;
        let detailed = known(station.read_detailed_status().await)?;
        (origin.brief, origin.detailed, origin.read_at) = (brief, detailed, Some(read_at));
        origin.station = Some(station.number());
        Ok(())
    }

    /// Asks whether the PLC is the one that was asked before, as far as that is known.
    async fn look_again(&self, station: &Station) -> Result<(), BackupError> {
        let Origin { station: before, detailed, .. } = &self.backup.origin;
        if let Some(backup) = before.filter(|&before| before != station.number()) {
            return Err(BackupError::OtherStation { backup, station: station.number() });
        }
        let Some(backup) = detailed else { return Ok(()) };
        let plc = known(station.read_detailed_status().await).map_err(|error| self.failed(error))?;
        let model = |status: &DetailedStatus| (status.main_unit(), status.io_points_code());
        match plc {
            Some(plc) if model(&plc) == model(backup) => Ok(()),
            plc => Err(BackupError::OtherPlc { backup: Box::new(backup.clone()), plc: plc.map(Box::new) }),
        }
    }

    fn failed(&self, source: Error) -> BackupError {
        BackupError::Call { partial: Box::new(self.backup.clone()), source }
    }

    fn done(&self) -> usize {
        self.backup.elements().filter(|(_, cell)| *cell != Err(Missing::NotRead)).count()
    }
}

impl fmt::Debug for TakeBackup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TakeBackup").field("done", &self.done()).finish_non_exhaustive()
    }
}

/// What a PLC refuses to tell is not known; not every model tells all of itself.
fn known<T>(reply: Result<T, Error>) -> Result<Option<T>, Error> {
    match reply {
        Ok(reply) => Ok(Some(reply)),
        Err(Error::Plc { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

fn whole_seconds(time: SystemTime) -> SystemTime {
    let seconds = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs();
    SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(seconds)).unwrap_or(SystemTime::UNIX_EPOCH)
}

/// Has these asked for again, and gives the number of their elements.
fn again(chunks: &mut Chunks, dropped: Vec<Chunk>) -> usize {
    let elements = dropped.iter().map(|chunk| chunk.count).sum();
    chunks.again(dropped);
    elements
}

/// Reads a part of a range in one request of a job. `shorter`: the last element may be left to the next request.
pub(super) async fn fetch<M: Copy>(
    job: &mut StationJob<'_, M>,
    mark: M,
    chunk: Chunk,
    shorter: bool,
) -> Result<Outcome<M, Vec<Value>>, Error> {
    let (first, count) = (chunk.names().first(), chunk.count);
    // A value of two registers is never split.
    let longer = shorter && chunk.range.elements_per_value() == 1;
    Ok(match first {
        Element::Discrete(first) => job.call(mark, ReadDiscretes::new(first, count)?, longer).await?.map(values),
        Element::Register(first) => job.call(mark, ReadRegisters::new(first, count)?, longer).await?.map(values),
        Element::Register32(first) => job.call(mark, ReadRegisters::new(first, count)?, longer).await?.map(values),
    })
}

fn values(raw: Vec<impl Into<Value>>) -> Vec<Value> {
    raw.into_iter().map(Into::into).collect()
}

/// How many bytes these elements hold.
pub(super) fn content_len(range: Tag, count: usize) -> usize {
    match range.first().width() {
        Width::Bit => count.div_ceil(8),
        Width::Word => count.saturating_mul(2),
        Width::DWord => count.saturating_mul(4),
    }
}
