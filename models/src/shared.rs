//! The state that the threads of a link share: `src/link/shared.rs` and `src/link/io_waker.rs`.
//! Of the core there is only this: one request is on the wire at a time, the others are queued.

use std::future::poll_fn;
use std::task::{Poll, Waker};

use loom::future::{AtomicWaker, block_on};
use loom::sync::atomic::Ordering::{AcqRel, Acquire, Release};
use loom::sync::atomic::{AtomicBool, AtomicUsize};
use loom::sync::{Arc, Mutex};
use loom::thread;

use crate::lock::Lock;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Model {
    Callers,
    Wire,
}

/// How the task ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ending {
    /// When all calls are done. A wake-up that is lost is a deadlock.
    Done,
    /// The link is closed by a caller.
    Closed,
    /// It is dropped after its first turn.
    Dropped,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fault {
    /// A caller that has had the driver does not look into the inbox again.
    InboxForgotten,
    /// Nor does the task.
    LastLookForgotten,
    /// The task says how it is woken when it has looked, not before.
    WakerLate,
    /// The flag of the inbox is not set.
    NotPosted,
    /// The end relies on the flag of the inbox.
    EndByFlag,
    /// The task is woken before the ready flag is set.
    WokenBeforeReady,
    /// The ready flag is cleared after the read.
    ReadyClearedLate,
    /// Nothing is read before a request.
    NothingRead,
}

impl Model {
    pub(crate) const ALL: [Self; 2] = [Self::Callers, Self::Wire];
}

impl Ending {
    pub(crate) const ALL: [Self; 3] = [Self::Done, Self::Closed, Self::Dropped];
}

impl Fault {
    pub(crate) const ALL: [Self; 8] = [
        Self::InboxForgotten,
        Self::LastLookForgotten,
        Self::WakerLate,
        Self::NotPosted,
        Self::EndByFlag,
        Self::WokenBeforeReady,
        Self::ReadyClearedLate,
        Self::NothingRead,
    ];
}

/// Of which call; or what came before any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Bytes {
    Stale,
    ReplyTo(usize),
}

struct Shared {
    model: Model,
    fault: Option<Fault>,
    inbox: Mutex<Vec<usize>>,
    posted: AtomicBool,
    /// Until the task has ended.
    slot: Lock<Option<DriverSlot>>,
    closed: AtomicBool,
    line: Arc<Line>,
    /// How often each call has ended.
    ended: Vec<AtomicUsize>,
}

struct Line {
    fault: Option<Fault>,
    /// What has come, and whether somebody is to be woken when more does.
    came: Mutex<(Vec<Bytes>, bool)>,
    io_waker: IoWaker,
}

struct IoWaker {
    task: AtomicWaker,
    ready: AtomicBool,
}

struct DriverSlot {
    queue: Vec<usize>,
    active: Option<usize>,
    read_armed: bool,
}

impl Line {
    fn read(&self) -> Option<Bytes> {
        let mut came = self.came.lock().unwrap();
        if came.0.is_empty() {
            came.1 = true;
            return None;
        }
        Some(came.0.remove(0))
    }

    /// Something comes: whoever found nothing is woken, as a socket does it.
    fn come(&self, bytes: Bytes) {
        let mut came = self.came.lock().unwrap();
        came.0.push(bytes);
        let wakes = std::mem::take(&mut came.1);
        drop(came);
        if !wakes {
            return;
        }
        if self.fault == Some(Fault::WokenBeforeReady) {
            self.io_waker.task.wake();
            self.io_waker.ready.store(true, Release);
        } else {
            self.io_waker.ready.store(true, Release);
            self.io_waker.task.wake();
        }
    }
}

impl Shared {
    fn has(&self, fault: Fault) -> bool {
        self.fault == Some(fault)
    }

    fn end_call(&self, call: usize) {
        assert_eq!(self.ended[call].fetch_add(1, AcqRel), 0, "a call has ended twice");
    }

    fn all_ended(&self) -> bool {
        self.ended.iter().all(|times| times.load(Acquire) == 1)
    }

    fn submit(&self, call: usize) {
        if self.closed.load(Acquire) {
            return self.end_call(call);
        }
        match self.slot.try_lock() {
            None => {
                let mut inbox = self.inbox.lock().unwrap();
                inbox.push(call);
                if !self.has(Fault::NotPosted) {
                    self.posted.store(true, Release);
                }
                drop(inbox);
                return self.drain_inbox();
            }
            Some(mut slot) => {
                let mut calls = self.take_inbox();
                calls.push(call);
                self.serve(slot.as_mut(), calls);
            }
        }
        if !self.has(Fault::InboxForgotten) {
            self.drain_inbox();
        }
    }

    fn drain_inbox(&self) {
        while !self.inbox.lock().unwrap().is_empty() {
            let Some(mut slot) = self.slot.try_lock() else { return };
            let calls = self.take_inbox();
            self.serve(slot.as_mut(), calls);
        }
    }

    fn take_inbox(&self) -> Vec<usize> {
        if !self.posted.load(Acquire) {
            return Vec::new();
        }
        let mut inbox = self.inbox.lock().unwrap();
        self.posted.store(false, Release);
        std::mem::take(&mut *inbox)
    }

    fn serve(&self, slot: Option<&mut DriverSlot>, calls: Vec<usize>) {
        let Some(slot) = slot else {
            return calls.into_iter().for_each(|call| self.end_call(call));
        };
        let free = slot.active.is_none();
        slot.queue.extend(calls);
        if free {
            self.advance(slot);
        }
    }

    /// As the driver does, for the task or a caller.
    fn advance(&self, slot: &mut DriverSlot) {
        slot.read_armed = slot.read_armed && !self.line.io_waker.ready.load(Acquire)
            || self.has(Fault::NothingRead) && slot.active.is_none();
        loop {
            if !slot.read_armed {
                self.read_all(slot);
                slot.read_armed = true;
            }
            if slot.active.is_some() || slot.queue.is_empty() {
                return;
            }
            let call = slot.queue.remove(0);
            slot.active = Some(call);
            match self.model {
                Model::Callers => self.line.come(Bytes::ReplyTo(call)),
                Model::Wire => {
                    let peer = self.line.clone();
                    thread::spawn(move || peer.come(Bytes::ReplyTo(call)));
                }
            }
        }
    }

    fn read_all(&self, slot: &mut DriverSlot) {
        if !self.has(Fault::ReadyClearedLate) {
            self.line.io_waker.ready.swap(false, AcqRel);
        }
        while let Some(bytes) = self.line.read() {
            match slot.active.take() {
                None => assert_eq!(bytes, Bytes::Stale, "nobody has asked for it"),
                Some(call) => {
                    assert_eq!(bytes, Bytes::ReplyTo(call), "a call gets what is not its reply");
                    self.end_call(call);
                }
            }
        }
        if self.has(Fault::ReadyClearedLate) {
            self.line.io_waker.ready.swap(false, AcqRel);
        }
    }

    /// A turn of the task.
    fn poll(&self, waker: &Waker) -> Poll<()> {
        if !self.has(Fault::WakerLate) {
            self.line.io_waker.task.register(waker.clone());
        }
        loop {
            let mut guard = self.slot.lock();
            let Some(slot) = guard.as_mut() else { return Poll::Ready(()) };
            let closed = self.closed.load(Acquire);
            slot.queue.extend(self.take_inbox());
            if closed {
                std::mem::take(&mut slot.queue).into_iter().for_each(|call| self.end_call(call));
            }
            self.advance(slot);
            if closed && slot.active.is_none() {
                return Poll::Ready(());
            }
            drop(guard);
            if self.has(Fault::LastLookForgotten) || self.inbox.lock().unwrap().is_empty() {
                break;
            }
        }
        if self.has(Fault::WakerLate) {
            self.line.io_waker.task.register(waker.clone());
        }
        Poll::Pending
    }

    fn end(&self) {
        self.closed.store(true, Release);
        let slot = self.slot.lock().take();
        if let Some(slot) = slot {
            slot.queue.into_iter().chain(slot.active).for_each(|call| self.end_call(call));
        }
        let left = match self.has(Fault::EndByFlag) {
            true => self.take_inbox(),
            false => std::mem::take(&mut *self.inbox.lock().unwrap()),
        };
        left.into_iter().for_each(|call| self.end_call(call));
    }

    fn close(&self) {
        self.closed.store(true, Release);
        self.line.io_waker.task.wake();
    }
}

const CALLS: usize = 2;

pub(crate) fn run(model: Model, ending: Ending, fault: Option<Fault>, bound: usize) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(bound);
    builder.max_branches = 100_000;
    builder.check(move || {
        let shared = Arc::new(Shared {
            model,
            fault,
            inbox: Mutex::new(Vec::new()),
            posted: AtomicBool::new(false),
            slot: Lock::new(Some(DriverSlot { queue: Vec::new(), active: None, read_armed: false })),
            closed: AtomicBool::new(false),
            line: Arc::new(Line {
                fault,
                came: Mutex::new((Vec::new(), false)),
                io_waker: IoWaker { task: AtomicWaker::new(), ready: AtomicBool::new(false) },
            }),
            ended: (0..CALLS).map(|_| AtomicUsize::new(0)).collect(),
        });
        let others = match model {
            Model::Callers => callers(&shared, ending),
            Model::Wire => caller(&shared, ending),
        };
        match ending {
            Ending::Done => block_on(poll_fn(|cx| match shared.poll(cx.waker()) {
                Poll::Pending if !shared.all_ended() => Poll::Pending,
                _ => Poll::Ready(()),
            })),
            Ending::Closed => block_on(poll_fn(|cx| shared.poll(cx.waker()))),
            Ending::Dropped => block_on(poll_fn(|cx| {
                let _ = shared.poll(cx.waker());
                Poll::Ready(())
            })),
        }
        if ending != Ending::Done {
            shared.end();
        }
        others.into_iter().for_each(|thread| thread.join().unwrap());
        assert!(shared.all_ended(), "a call is left");
    });
}

/// Two callers; the last one closes the link when it has called.
fn callers(shared: &Arc<Shared>, ending: Ending) -> Vec<thread::JoinHandle<()>> {
    let caller = |call| {
        let shared = shared.clone();
        thread::spawn(move || {
            shared.submit(call);
            if ending == Ending::Closed && call == CALLS - 1 {
                shared.close();
            }
        })
    };
    (0..CALLS).map(caller).collect()
}

/// One caller. Something has come before it calls.
fn caller(shared: &Arc<Shared>, ending: Ending) -> Vec<thread::JoinHandle<()>> {
    let caller = shared.clone();
    let caller = thread::spawn(move || {
        caller.line.come(Bytes::Stale);
        (0..CALLS).for_each(|call| caller.submit(call));
        if ending == Ending::Closed {
            caller.close();
        }
    });
    vec![caller]
}
