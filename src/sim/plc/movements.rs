//! Movements of a simulated PLC: values that its process changes with time.
//!
//! No task and no tick: a value is computed when a request, or the test, accesses its elements. All values
//! of a request are those of one time.

use std::mem;
use std::time::Duration;

use tokio::time::Instant;

use super::{Plc, PlcInner};
use crate::command::{Command, Run};
use crate::element::Element;
use crate::sim::span::Span;
use crate::sim::{Error, Movement, MovementError};
use crate::tag::Tag;

impl Plc {
    /// Lets the process change the values of a tag with time, each of them by this movement.
    ///
    /// - The time of all movements of a PLC starts with the first of them. It is that of Tokio, so that a
    ///   test can pause it (`tokio::time::pause`).
    /// - A movement replaces those that have elements in common with it.
    /// - Values are rounded to the nearest one of the tag. Values of [`Shape::Random`] differ from each other.
    /// - A client's write lasts until the next access: the process overwrites it. A disabled discrete keeps
    ///   its state until it is enabled, as with [`write`](Self::write).
    /// - A [`write`](Self::write) of the process ends the movements of its elements.
    /// - RUN and STOP make no difference.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::{sim, tag};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let bench = sim::station().await;
    /// bench.plc.set_movement(tag!("R5:i16*0.1"), "ramp(0..100,10s)".parse()?)?;
    ///
    /// tokio::time::advance(Duration::from_millis(2500)).await;
    /// let level: f64 = bench.station.read(tag!("R5:i16*0.1")).await?;
    /// assert_eq!(level, 25.0);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// [`MovementError::WrongTag`] for a text and for bits of a register, [`MovementError::OutOfRange`] if the
    /// tag cannot hold the first or the second number, and [`MovementError::Plc`] for an element beyond the
    /// memory of the model. Nothing is changed then.
    ///
    /// [`Shape::Random`]: crate::sim::Shape::Random
    pub fn set_movement(&self, tag: Tag, movement: Movement) -> Result<(), MovementError> {
        let mut inner = self.lock();
        if let Some(element) = tag.elements().find(|&element| !inner.model.has(element)) {
            return Err(Error::BeyondModel { element }.into());
        }
        let moving = |tag: Tag| Ok(Moving { tag, span: span_of(&tag), movement: movement.of(&tag)? });
        let moving: Vec<Moving> = tag.singles().map(moving).collect::<Result<_, MovementError>>()?;
        inner.movements.end(span_of(&tag));
        inner.movements.began.get_or_insert_with(Instant::now);
        inner.movements.moving.extend(moving);
        Ok(())
    }
}

/// The movements of a PLC. No two of them have an element in common.
#[derive(Debug, Default)]
pub(super) struct Movements {
    /// When the first one was set.
    began: Option<Instant>,
    moving: Vec<Moving>,
}

/// A value that moves.
#[derive(Debug)]
struct Moving {
    /// Tag of one value.
    tag: Tag,
    span: Span,
    movement: Movement,
}

impl Movements {
    /// Ends the movements that have elements in common with the span.
    pub(super) fn end(&mut self, span: Span) {
        self.moving.retain(|moving| !moving.span.overlaps(span));
    }

    /// The time since the start; `None` if nothing moves.
    fn elapsed(&self) -> Option<Duration> {
        self.began.filter(|_| !self.moving.is_empty()).map(|began| began.elapsed())
    }
}

impl PlcInner {
    /// Computes the moving values that the request accesses.
    pub(super) fn move_accessed<C: Command>(&mut self, request: &C) {
        if let Some(elapsed) = self.movements.elapsed() {
            request.for_each_run(&mut |run: Run| self.move_span(Span::new(run.first, run.count), elapsed));
        }
    }

    /// Computes the moving values of an element.
    pub(super) fn move_element(&mut self, element: Element) {
        if let Some(elapsed) = self.movements.elapsed() {
            self.move_span(Span::new(element, 1), elapsed);
        }
    }

    fn move_span(&mut self, span: Span, elapsed: Duration) {
        let moving = mem::take(&mut self.movements.moving);
        let mut raw = Vec::new();
        for Moving { tag, movement, .. } in moving.iter().filter(|moving| moving.span.overlaps(span)) {
            raw.clear();
            // Succeeds: the tag holds both ends of the movement, and the model has its elements.
            tag.encode_nearest(movement.value(elapsed), &mut raw);
            for (element, &value) in tag.elements().zip(&raw) {
                let _ = self.write_as_process(element, value);
            }
        }
        self.movements.moving = moving;
    }
}

fn span_of(tag: &Tag) -> Span {
    Span::new(tag.first(), tag.element_count())
}

#[cfg(test)]
mod tests;
