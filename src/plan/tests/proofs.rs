//! Plans with the proofs of the link, beside an enumeration of all plans in all orders.
#![allow(clippy::print_stdout, reason = "prints figures")]

use std::collections::BTreeMap;

use super::enumerate::{Enumeration, Smallest, blocks, smallest};
use super::words::{random_tag_near_discretes, serial, tags_are_readable, word_limits};
use super::*;
use crate::command::{Code, LoopBack, ReadMixed};
use crate::plan::proofs::ProofPrices;

/// The command and the length of a reply.
type Shape = (Code, usize);

/// A request with its cost, its reply, and the price of a mixed read in its place.
#[derive(Clone, Copy)]
struct Exchange {
    cost: u64,
    shape: Shape,
    other: Option<u64>,
}

/// The rule of the link, in other words than the planner's.
struct Line<'a> {
    limits: &'a Limits,
    model: &'a CostModel,
}

impl Line<'_> {
    fn exchange(&self, request: &ReadRequest) -> Exchange {
        let framing = self.model.framing();
        let cost = self.model.cost(frames(request, framing));
        let read = elements(request);
        let reply: usize = read.iter().map(|element| framing.value_len(element.width())).sum();
        let units: usize = read.iter().map(|element| element.width().units()).sum();
        let fits = request.code() != Code::ReadMixed && units <= self.limits.mixed_units() as usize;
        let mixed = fits.then(|| ReadRequest::Mixed(ReadMixed::new(read).unwrap()));
        let mixed = mixed.filter(|mixed| mixed.check(framing).is_ok());
        let more = mixed.map(|mixed| self.model.bytes_cost(frames(&mixed, framing) - frames(request, framing)));
        // The link compares with a loop-back on a PLC that answers after 5 ms.
        let fixed = self.model.with_response_time(Duration::from_millis(5)).with_overhead(Duration::ZERO);
        let other = more.filter(|more| *more < fixed.cost(2 * framing.frame_overhead()));
        Exchange { cost, shape: (request.code(), reply), other }
    }

    /// Returns the price of a request behind a reply of this shape, and the shape of its own reply.
    fn behind(&self, last: Option<Shape>, exchange: &Exchange) -> (u64, Shape) {
        match exchange.other {
            _ if last != Some(exchange.shape) => (exchange.cost, exchange.shape),
            Some(more) => (exchange.cost + more, (Code::ReadMixed, exchange.shape.1)),
            None => (exchange.cost + self.check(LoopBack::empty()), exchange.shape),
        }
    }

    fn check(&self, check: LoopBack) -> u64 {
        let mut bytes = BytesMut::new();
        encode_request(&check, self.model.framing(), 1, &mut bytes).unwrap();
        self.model.cost(2 * bytes.len())
    }

    /// Returns the cost of requests in this order.
    fn sequence(&self, requests: impl IntoIterator<Item = Exchange>) -> u64 {
        let (mut cost, mut replies): (u64, Vec<Shape>) = (0, Vec::new());
        for exchange in requests {
            let (price, reply) = self.behind(replies.last().copied(), &exchange);
            cost += price;
            replies.push(reply);
        }
        cost + self.end(&replies)
    }

    /// Returns the price of the check at the end of a job with these replies.
    fn end(&self, replies: &[Shape]) -> u64 {
        let Some((last, before)) = replies.split_last() else { return 0 };
        if before.contains(last) { self.check(LoopBack::nonce(1)) } else { 0 }
    }

    fn plan(&self, plan: &Plan) -> u64 {
        self.sequence(plan.requests().iter().map(|planned| self.exchange(planned.request())))
    }
}

/// All sequences of requests that read some parts.
struct Sequences<'a> {
    line: &'a Line<'a>,
    /// For each set of parts, the requests that read it.
    exchanges: Vec<Vec<Exchange>>,
    /// For each set of parts, the cost of the cheapest requests without proofs.
    least: Vec<u64>,
    best: u64,
}

impl Sequences<'_> {
    /// Finds a sequence for the set `rest` behind these replies that is cheaper than `best`.
    fn search(&mut self, rest: usize, cost: u64, replies: &mut Vec<Shape>) {
        if rest == 0 {
            self.best = self.best.min(cost + self.line.end(replies));
            return;
        }
        let mut set = rest;
        while set != 0 {
            for n in 0..self.exchanges[set].len() {
                let (price, reply) = self.line.behind(replies.last().copied(), &self.exchanges[set][n]);
                if (cost + price).saturating_add(self.least[rest ^ set]) < self.best {
                    replies.push(reply);
                    self.search(rest ^ set, cost + price, replies);
                    replies.pop();
                }
            }
            set = (set - 1) & rest;
        }
    }
}

/// Returns the cost of the cheapest sequence if it is lower than `best`, else `best`; and the number of
/// lists that are ambiguous.
fn cheapest_sequence(parts: &[Smallest], line: &Line<'_>, best: u64) -> (u64, usize) {
    let mut enumeration = Enumeration { limits: line.limits, model: line.model, ambiguous: 0 };
    let exchanges: Vec<Vec<Exchange>> = blocks(parts)
        .map(|block| {
            let requests = if block.is_empty() { Vec::new() } else { enumeration.requests(&block) };
            let mut cheapest: BTreeMap<(Shape, Option<u64>), Exchange> = BTreeMap::new();
            for exchange in requests.iter().map(|request| line.exchange(request)) {
                let known = cheapest.entry((exchange.shape, exchange.other)).or_insert(exchange);
                known.cost = known.cost.min(exchange.cost);
            }
            cheapest.into_values().collect()
        })
        .collect();
    let mut least = vec![0_u64];
    for set in 1..exchanges.len() {
        let mut lowest = u64::MAX;
        let mut block = set;
        while block != 0 {
            if let Some(price) = exchanges[block].iter().map(|exchange| exchange.cost).min() {
                lowest = lowest.min(price.saturating_add(least[set ^ block]));
            }
            block = (block - 1) & set;
        }
        least.push(lowest);
    }
    let all = exchanges.len() - 1;
    let mut sequences = Sequences { line, exchanges, least, best };
    sequences.search(all, 0, &mut Vec::new());
    (sequences.best, enumeration.ambiguous)
}

/// Returns the cost of requests in their best order.
fn in_best_order(plan: &Plan, line: &Line<'_>) -> u64 {
    let requests: Vec<Exchange> = plan.requests().iter().map(|planned| line.exchange(planned.request())).collect();
    let all = (1 << requests.len()) - 1;
    let mut exchanges = vec![Vec::new(); all + 1];
    requests.iter().enumerate().for_each(|(n, exchange)| exchanges[1 << n].push(*exchange));
    let members = |set: usize| requests.iter().enumerate().filter(move |(n, _)| set >> n & 1 == 1);
    let least = (0..=all).map(|set| members(set).map(|(_, exchange)| exchange.cost).sum()).collect();
    let mut sequences = Sequences { line, exchanges, least, best: line.plan(plan) + 1 };
    sequences.search(all, 0, &mut Vec::new());
    sequences.best
}

/// A tag of few kinds, so that replies often have one shape.
fn random_tag_of_few(random: &mut Choices) -> Tag {
    let (symbol, step) =
        random.one(&[(Symbol::R, 1), (Symbol::D, 1), (Symbol::RT, 1), (Symbol::M, 1), (Symbol::WM, 16)]);
    let address = step * (random.below(9) * 37 + random.below(3));
    let first = Element::new(symbol, u16::try_from(address).unwrap()).unwrap();
    match first.width() {
        Width::Word => Tag::new(first, TagType::F32, 1).ok().filter(|_| random.below(4) == 0).unwrap_or(first.into()),
        Width::Bit | Width::DWord => first.into(),
    }
}

/// The sets of parts that were compared, and their costs.
#[derive(Default)]
struct Loss {
    sets: usize,
    optimal: usize,
    paid: u64,
    least: u64,
    /// In thousandths.
    worst: u64,
}

impl Loss {
    fn add(&mut self, paid: u64, least: u64) {
        self.sets += 1;
        self.optimal += usize::from(paid == least);
        self.paid += paid;
        self.least += least;
        self.worst = self.worst.max((paid - least) * 1000 / least);
    }

    fn print(&self, name: &str) {
        if self.sets == 0 {
            return;
        }
        println!(
            "{name}: {:.2} % more than the optimum, at most {:.1} %; {} of {} sets optimal",
            (self.paid - self.least) as f64 * 100.0 / self.least as f64,
            self.worst as f64 / 10.0,
            self.optimal,
            self.sets
        );
    }
}

/// The number of random sets, by default `usual`.
pub(super) fn seeds(usual: u64) -> u64 {
    std::env::var("FATEK_PLAN_SEEDS").map_or(usual, |n| n.parse().unwrap())
}

/// Seed to model, limits and tags. `None` if the limits exclude a tag.
fn set_of(seed: u64, least: usize, most: usize) -> Option<(CostModel, Limits, Vec<Tag>)> {
    let mut random = Choices(Random::new(seed));
    let limits = random.one(&["runs", "runs, no words", "few units", "any", "any"]);
    let limits = match limits {
        "runs" => Limits::new().mixed_reads(false),
        "runs, no words" => Limits::new().mixed_reads(false).words_of_discretes(false),
        "few units" => {
            Limits::new().max_mixed(2 + random.below(3)).unwrap().max_registers(2 + random.below(6)).unwrap()
        }
        _ => word_limits()[random.below(word_limits().len())].clone(),
    };
    let model = random.one(&models());
    let count = least + random.below(most - least + 1);
    let few = random.below(2) == 0;
    let tags: Vec<Tag> = (0..count)
        .map(|_| if few { random_tag_of_few(&mut random) } else { random_tag_near_discretes(&mut random) })
        .collect();
    (tags_are_readable(&tags, &limits) && limits != Limits::new().words_at_multiples_of_16(true))
        .then_some((model, limits, tags))
}

#[test]
fn no_sequence_of_requests_is_cheaper_for_up_to_8_values() {
    let seeds = seeds(100);
    let (mut loss, mut ambiguous, mut without) = (Loss::default(), Loss::default(), Loss::default());
    for seed in 0..seeds {
        // Eight values are slow in a debug build.
        let (least, most) = if seed % 100 == 99 { (8, 8) } else { (2, 6) };
        let Some((model, limits, mut tags)) = set_of(seed, least, most) else { continue };
        let (mut random, mut in_group) = (Choices(Random::new(seed)), 0);
        match seed % 6 {
            0 => in_group = 2,
            1 => {
                *tags.last_mut().unwrap() =
                    text(Register::r(u16::try_from(random.below(80)).unwrap()).into(), 1 + random.below(10))
            }
            _ => {}
        }
        let builder = |model| {
            let (group, others) = tags.split_at(in_group);
            let others = others.iter().copied();
            Plan::builder(model).limits(limits.clone()).one_scan(group.iter().copied()).tags(others)
        };
        let Ok(plan) = builder(model).build() else { continue };
        let line = Line { limits: &limits, model: &model };
        let (group, others) = tags.split_at(in_group);
        let group = (!group.is_empty()).then(|| smallest(group));
        let parts: Vec<_> = group.into_iter().chain(others.iter().map(|tag| smallest(&[*tag]))).collect();
        let paid = line.plan(&plan);
        let context = format!("seed {seed}, {model:?}, {limits:?}, {tags:?}");
        check(&plan, &model, &limits, &context);
        assert_eq!(plan.time(), Duration::from_nanos(paid), "{context}\n{}", plan.explain());
        let (optimum, lists) = cheapest_sequence(&parts, &line, paid);
        // Another choice of words with a reply of this length may not be ambiguous.
        if lists > 0 {
            ambiguous.add(paid, optimum);
            continue;
        }
        loss.add(paid, optimum);
        assert_eq!(paid, optimum, "{context}\n{}", plan.explain());
        let model = model.with_proofs(false);
        let chosen_without = builder(model).build().unwrap();
        without.add(in_best_order(&chosen_without, &line), optimum);
    }
    loss.print("up to 8 values");
    without.print("requests chosen without proofs, in their best order");
    assert!(without.paid > loss.paid, "no set shows that proofs matter");
    ambiguous.print("with ambiguous lists");
    assert!(loss.sets as u64 * 2 > seeds, "{} sets", loss.sets);
}

/// The order for many requests beside the best one, for as many as can be compared.
#[test]
fn the_order_of_many_requests_is_close_to_the_best() {
    let (mut loss, mut given) = (Loss::default(), 0);
    for seed in 0..400 {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()), Limits::new().mixed_reads(random.below(2) == 0));
        let drafts: Vec<Draft> = (0..2 + random.below(7))
            .map(|n| {
                let first = Element::from(Register::r(u16::try_from(n * 100).unwrap()));
                let cells = Cells::of(first, 1 + random.below(3), &limits).unwrap();
                let mixed = limits.mixed_units() > 0 && random.below(4) == 0;
                if mixed { Draft::mixed_of(&[cells], &limits, &model).unwrap() } else { Draft::Run(cells) }
            })
            .collect();
        let prices = ProofPrices::new(&model);
        let exchanges = order::exchanges(drafts.iter(), &limits, &model);
        let (many, few) = (order::cheap_order(&exchanges, prices), order::cheapest_order(&exchanges, prices));
        let line = Line { limits: &limits, model: &model };
        let sum: u64 = drafts.iter().map(|draft| draft.cost(&model)).sum();
        let priced =
            |order: &[usize]| line.sequence(order.iter().map(|n| line.exchange(&drafts[*n].request().unwrap())));
        assert_eq!((sum + many.1, sum + few.1), (priced(&many.0), priced(&few.0)), "seed {seed}");
        loss.add(sum + many.1, sum + few.1);
        given += priced(&(0..drafts.len()).collect::<Vec<_>>());
    }
    loss.print("order of many requests");
    println!("the orders as given: {:.2} % more", (given - loss.least) as f64 * 100.0 / loss.least as f64);
    assert!((loss.paid - loss.least) * 100 < loss.least, "{} ns instead of {} ns", loss.paid, loss.least);
}

/// Plans for many values beside a lower bound: their requests without proofs, as long as they can be.
#[test]
fn many_values_of_one_kind_need_few_proofs() {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let scattered: Vec<Tag> = (0..1000).map(|n| Tag::from(Element::from(Register::r(n * 65)))).collect();
    let sets: [(&str, Vec<Tag>, Limits); 4] = [
        ("1000 scattered registers", scattered, Limits::new()),
        ("R0-R999", vec![tag("R0-R999")], Limits::new()),
        ("R0-R999, no mixed reads", vec![tag("R0-R999")], Limits::new().mixed_reads(false)),
        ("M0-M1999 as discretes", vec![tag("M0-M1999")], Limits::new().mixed_reads(false).words_of_discretes(false)),
    ];
    for model in [serial(), network] {
        for (name, tags, limits) in &sets {
            let plan = |model| Plan::builder(model).limits(limits.clone()).tags(tags.iter().copied()).build().unwrap();
            let (with, without) = (plan(model), plan(model.with_proofs(false)));
            check(&with, &model, limits, name);
            let line = Line { limits, model: &model };
            let before = Duration::from_nanos(line.plan(&without));
            println!(
                "{name}: {:?} without proofs, {before:?} with those of that plan, {:?}",
                without.time(),
                with.time()
            );
            assert_eq!(with.time(), Duration::from_nanos(line.plan(&with)), "{name}");
            assert!(with.time() <= before && with.time() * 100 < without.time() * 102, "{name}\n{}", with.explain());
        }
    }
}

/// The planner for many values beside the best sequence of requests.
#[test]
fn many_values_have_few_more_proofs_than_the_best_sequence() {
    let mut losses = [Loss::default(), Loss::default(), Loss::default()];
    let mut without = Loss::default();
    for seed in 0..seeds(400) {
        let Some((model, limits, tags)) = set_of(seed, 4, 8) else { continue };
        if Plan::builder(model).limits(limits.clone()).tags(tags.clone()).build().is_err() {
            continue;
        }
        let values = parts(&tags, &limits).concat();
        // Planned as a group.
        if values.iter().any(|value| value.len > value.area.max_run(&limits)) {
            continue;
        }
        let best = solve::solve_exact(&[], &values, &limits, &model).price();
        let single = solve::single_request(&[], &values, &limits, &model).map(|(draft, _)| draft.cost(&model));
        let large = |model: &CostModel| solve::solve_large(&[], &values, &limits, model);
        let paid = single.unwrap_or_else(|| large(&model).price());
        let place = match model.framing() {
            Framing::Binary => 2,
            Framing::Ascii => usize::from(limits.mixed_units() > 0),
        };
        losses[place].add(paid, best);
        let drafts: Vec<Draft> = match single {
            Some(_) => continue,
            None => large(&model.with_proofs(false)).shares.into_iter().map(|(draft, _)| draft).collect(),
        };
        let exchanges = order::exchanges(drafts.iter(), &limits, &model);
        let (_, proofs) = order::cheapest_order(&exchanges, ProofPrices::new(&model));
        without.add(drafts.iter().map(|draft| draft.cost(&model)).sum::<u64>() + proofs, best);
    }
    for (loss, name) in losses.iter().zip(["ASCII, runs only", "ASCII, low limits", "binary"]) {
        loss.print(name);
    }
    without.print("several requests chosen without proofs, in their best order");
    for loss in losses {
        assert!((loss.paid - loss.least) * 100 < loss.least * 4, "{} ns instead of {} ns", loss.paid, loss.least);
    }
}
