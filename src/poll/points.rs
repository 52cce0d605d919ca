//! The tags of a station by their ids. Tags that were removed are not there any more, whoever still has their id.
//!
//! Most stations of a service have few tags, and there are thousands of stations: so there is as much memory as there are
//! tags and no more, which a B-tree, with its room for eleven in a node, does not have.

use super::TagId;
use super::point::Point;

#[derive(Debug, Default)]
#[expect(clippy::vec_box, reason = "many of them are removed one by one, and each removal moves those behind it")]
pub(super) struct Points {
    /// In the order of their ids, each once.
    points: Vec<Box<Point>>,
}

impl Points {
    pub(super) fn get(&self, id: TagId) -> Option<&Point> {
        self.points.get(self.place(id).ok()?).map(|point| &**point)
    }

    pub(super) fn get_mut(&mut self, id: TagId) -> Option<&mut Point> {
        let at = self.place(id).ok()?;
        self.points.get_mut(at).map(|point| &mut **point)
    }

    pub(super) fn contains(&self, id: TagId) -> bool {
        self.place(id).is_ok()
    }

    /// Adds points with ids that are not there.
    pub(super) fn extend(&mut self, points: impl ExactSizeIterator<Item = Point>) {
        if self.points.is_empty() {
            self.points.reserve_exact(points.len());
        }
        self.points.extend(points.map(Box::new));
        // Ids are given in ascending order, so that nearly always nothing is to be done.
        if !self.points.is_sorted_by_key(|point| point.id) {
            self.points.sort_unstable_by_key(|point| point.id);
        }
    }

    pub(super) fn remove(&mut self, id: TagId) -> bool {
        let place = self.place(id);
        if let Ok(at) = place {
            self.points.remove(at);
        }
        place.is_ok()
    }

    pub(super) fn values(&self) -> impl Iterator<Item = &Point> {
        self.points.iter().map(|point| &**point)
    }

    fn place(&self, id: TagId) -> Result<usize, usize> {
        self.points.binary_search_by_key(&id, |point| point.id)
    }
}
