//! Model of the state that the threads of a link share: `src/link/shared.rs` and
//! `src/link/io_waker.rs`.
//!
//! Of the core it has one rule: one request is on the wire at a time, the others are queued.

use std::future::poll_fn;
use std::task::{Poll, Waker};

use loom::future::block_on;
use loom::sync::atomic::Ordering::{AcqRel, Acquire, Release, SeqCst};
use loom::sync::atomic::{AtomicBool, AtomicUsize, fence};
use loom::sync::{Arc, Mutex};
use loom::thread;

use crate::lock::Lock;

/// Model, as described in the README.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Model {
    Callers,
    Wire,
}

/// End of the link task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ending {
    /// After all calls. A lost wake-up is a deadlock.
    Done,
    /// A caller closes the link.
    Closed,
    /// The task is dropped after its first poll.
    Dropped,
}

/// Planted fault, which the model must detect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fault {
    /// A caller does not check the inbox after it has released the driver.
    InboxForgotten,
    /// The task does not check the inbox after it has released the driver.
    LastCheckForgotten,
    /// The task registers its waker after its work, not before.
    WakerLate,
    /// Nothing orders the release of the driver before the look at the inbox flag.
    NoFence,
    /// The inbox flag is not set.
    NotPosted,
    /// The end of the task relies on the inbox flag.
    EndByFlag,
    /// The task is woken before the ready flag is set.
    WokenBeforeReady,
    /// The ready flag is cleared after the read.
    ReadyClearedLate,
    /// Stale bytes are not read before a request.
    NothingRead,
}

impl Model {
    pub(crate) const ALL: [Self; 2] = [Self::Callers, Self::Wire];
}

impl Ending {
    pub(crate) const ALL: [Self; 3] = [Self::Done, Self::Closed, Self::Dropped];
}

impl Fault {
    pub(crate) const ALL: [Self; 9] = [
        Self::InboxForgotten,
        Self::LastCheckForgotten,
        Self::WakerLate,
        Self::NoFence,
        Self::NotPosted,
        Self::EndByFlag,
        Self::WokenBeforeReady,
        Self::ReadyClearedLate,
        Self::NothingRead,
    ];
}

/// Bytes on the line: the reply to a call, or stale bytes.
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
    /// `None` after the end of the task.
    slot: Lock<Option<DriverSlot>>,
    closed: AtomicBool,
    line: Arc<Line>,
    /// Number of ends of each call; each must be 1.
    ended: Vec<AtomicUsize>,
}

struct Line {
    fault: Option<Fault>,
    /// Received bytes, and whether the reader waits for more.
    received: Mutex<(Vec<Bytes>, bool)>,
    io_waker: IoWaker,
}

struct IoWaker {
    task: Mutex<Option<Waker>>,
    ready: AtomicBool,
}

impl IoWaker {
    fn wake_task(&self) {
        if let Some(task) = &*self.task.lock().unwrap() {
            task.wake_by_ref();
        }
    }
}

struct DriverSlot {
    /// The task is registered.
    has_task: bool,
    queue: Vec<usize>,
    active: Option<usize>,
    read_armed: bool,
}

impl Line {
    fn read(&self) -> Option<Bytes> {
        let mut received = self.received.lock().unwrap();
        if received.0.is_empty() {
            received.1 = true;
            return None;
        }
        Some(received.0.remove(0))
    }

    /// Receives bytes, and wakes a waiting reader, as a socket does.
    fn receive(&self, bytes: Bytes) {
        let mut received = self.received.lock().unwrap();
        received.0.push(bytes);
        let waiting = std::mem::take(&mut received.1);
        drop(received);
        if !waiting {
            return;
        }
        if self.fault == Some(Fault::WokenBeforeReady) {
            self.io_waker.wake_task();
            self.io_waker.ready.store(true, Release);
        } else {
            self.io_waker.ready.store(true, Release);
            self.io_waker.wake_task();
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
        while self.has_posted() {
            let Some(mut slot) = self.slot.try_lock() else { return };
            let calls = self.take_inbox();
            self.serve(slot.as_mut(), calls);
        }
    }

    fn has_posted(&self) -> bool {
        if !self.has(Fault::NoFence) {
            fence(SeqCst);
        }
        self.posted.load(Acquire)
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

    /// Advances the driver, for the task or a caller.
    fn advance(&self, slot: &mut DriverSlot) {
        let ready = self.line.io_waker.ready.load(Acquire);
        slot.read_armed = slot.read_armed && !ready || self.has(Fault::NothingRead) && slot.active.is_none();
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
                Model::Callers => self.line.receive(Bytes::ReplyTo(call)),
                Model::Wire => {
                    let peer = self.line.clone();
                    thread::spawn(move || peer.receive(Bytes::ReplyTo(call)));
                }
            }
        }
    }

    fn read_all(&self, slot: &mut DriverSlot) {
        let clear = || {
            if self.line.io_waker.ready.load(Acquire) {
                self.line.io_waker.ready.swap(false, AcqRel);
            }
        };
        if !self.has(Fault::ReadyClearedLate) {
            clear();
        }
        while let Some(bytes) = self.line.read() {
            match slot.active.take() {
                None => assert_eq!(bytes, Bytes::Stale, "a reply without a request"),
                Some(call) => {
                    assert_eq!(bytes, Bytes::ReplyTo(call), "a call has the reply to another one");
                    self.end_call(call);
                }
            }
        }
        if self.has(Fault::ReadyClearedLate) {
            clear();
        }
    }

    /// Polls the task once.
    fn poll(&self, waker: &Waker) -> Poll<()> {
        loop {
            let mut guard = self.slot.lock();
            let Some(slot) = guard.as_mut() else { return Poll::Ready(()) };
            if !self.has(Fault::WakerLate) {
                self.register(slot, waker);
            }
            let closed = self.closed.load(Acquire);
            slot.queue.extend(self.take_inbox());
            if closed {
                std::mem::take(&mut slot.queue).into_iter().for_each(|call| self.end_call(call));
            }
            self.advance(slot);
            if closed && slot.active.is_none() {
                return Poll::Ready(());
            }
            if self.has(Fault::WakerLate) {
                self.register(slot, waker);
            }
            drop(guard);
            if self.has(Fault::LastCheckForgotten) || !self.has_posted() {
                return Poll::Pending;
            }
        }
    }

    /// Registers the task, with its first poll.
    fn register(&self, slot: &mut DriverSlot, task: &Waker) {
        // The waker is the same in each poll, but loom's do not know it.
        if !std::mem::replace(&mut slot.has_task, true) {
            *self.line.io_waker.task.lock().unwrap() = Some(task.clone());
        }
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
        self.line.io_waker.wake_task();
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
            slot: Lock::new(Some(DriverSlot { has_task: false, queue: Vec::new(), active: None, read_armed: false })),
            closed: AtomicBool::new(false),
            line: Arc::new(Line {
                fault,
                received: Mutex::new((Vec::new(), false)),
                io_waker: IoWaker { task: Mutex::new(None), ready: AtomicBool::new(false) },
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
        assert!(shared.all_ended(), "a call has not ended");
    });
}

/// Two callers. The last one closes the link after its call.
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

/// One caller, with stale bytes before its calls.
fn caller(shared: &Arc<Shared>, ending: Ending) -> Vec<thread::JoinHandle<()>> {
    let caller = shared.clone();
    let caller = thread::spawn(move || {
        caller.line.receive(Bytes::Stale);
        (0..CALLS).for_each(|call| caller.submit(call));
        if ending == Ending::Closed {
            caller.close();
        }
    });
    vec![caller]
}
