//! A plan for a struct of tags.

use std::fmt;
use std::marker::PhantomData;

use super::{CostModel, Limits, Plan, PlanBuilder, PlanError};
use crate::error::Error;
use crate::station::Station;
use crate::tag::{Field, Tags};

/// The plan of a struct of [`Tags`]: made once, read often.
///
#[cfg_attr(feature = "derive", doc = "```")]
#[cfg_attr(not(feature = "derive"), doc = "```ignore")]
/// use fatek::plan::{CostModel, StructPlan};
/// use fatek::Tags;
///
/// #[derive(Tags)]
/// struct Tank {
///     #[tag("R100:f32")]
///     level: f32,
///     #[tag("M7")]
///     alarm: bool,
/// }
/// # fatek::sim::doctest(|station| async move {
/// let plan = StructPlan::<Tank>::for_station(&station)?;
/// assert_eq!(plan.as_plan().requests().len(), 1);
/// for _ in 0..3 {
///     let tank = plan.read(&station).await?;
///     assert_eq!((tank.level, tank.alarm), (0.0, false));
/// }
/// # Ok(()) });
/// ```
pub struct StructPlan<T> {
    plan: Plan,
    /// For each field, the number of its tag in the plan.
    tags: Vec<usize>,
    of: PhantomData<fn() -> T>,
}

impl<T: Tags> StructPlan<T> {
    /// Makes a plan with these costs, within the limits of the protocol.
    ///
    /// # Errors
    /// Those of [`with_limits`](Self::with_limits).
    pub fn new(cost: CostModel) -> Result<Self, Error> {
        Self::with_limits(cost, Limits::new())
    }

    /// Makes a plan for a station: with its costs, within its [capabilities](Station::capabilities), as
    /// [`Plan::builder_for`] does.
    ///
    /// # Errors
    /// Those of [`with_limits`](Self::with_limits).
    pub fn for_station(station: &Station) -> Result<Self, Error> {
        Self::of(Plan::builder_for(station))
    }

    /// Makes a plan with these costs, within these limits.
    ///
    /// # Errors
    /// [`Error::Tag`] for a field whose type does not fit its tag, and for tags that no plan reads:
    /// those of a one-scan group that do not fit in one request, or that the limits exclude.
    /// [`Error::Invalid`] for an address that the framing does not have.
    pub fn with_limits(cost: CostModel, limits: Limits) -> Result<Self, Error> {
        Self::of(Plan::builder(cost).limits(limits))
    }

    fn of(mut builder: PlanBuilder) -> Result<Self, Error> {
        T::check()?;
        let mut tags = vec![0; T::FIELDS.len()];
        let mut count = 0;
        for (group, fields) in Field::by_group(T::FIELDS) {
            for &field in &fields {
                tags[field] = count;
                count += 1;
            }
            let of_group = fields.iter().map(|&field| T::FIELDS[field].tag());
            builder = if group.is_some() { builder.one_scan(of_group) } else { builder.tags(of_group) };
        }
        let plan = builder.build().map_err(PlanError::into_call_error)?;
        Ok(Self { plan, tags, of: PhantomData })
    }

    /// The plan. Its tags have the order of the requests of groups, not of the fields.
    #[must_use]
    pub fn as_plan(&self) -> &Plan {
        &self.plan
    }

    /// Reads the struct.
    ///
    /// # Errors
    /// Those of [every method](Station#errors), for the first field that fails: [`Error::RefusedTags`] names
    /// the tags of a request that the PLC refused. A read fails as a whole.
    ///
    /// Cancel-safe: it only reads.
    pub async fn read(&self, station: &Station) -> Result<T, Error> {
        let readings = self.plan.read(station).await;
        Ok(T::from_values(&readings.all_values(self.tags.iter().copied())?)?)
    }
}

impl<T> fmt::Debug for StructPlan<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StructPlan").field("plan", &self.plan).finish_non_exhaustive()
    }
}
