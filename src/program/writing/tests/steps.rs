//! One step at a time: what a STOP or RUN leaves that does not do as it should, and a dry run.

use super::*;

/// A writing that has come to this step, with all answered before.
fn at(world: &mut World, options: WriteOptions, step: Step) -> Writing {
    let mut writing = Writing::new(world.new.clone(), options);
    writing.begin(Goal::Write);
    let program = world.new.clone();
    while writing.next() != step {
        assert!(!matches!(writing.next(), Step::Done | Step::Failed), "{step:?} never comes");
        world.go(&mut writing, &program);
    }
    writing
}

#[test]
fn what_a_refused_or_unsent_stop_or_run_leaves_is_known_though_nothing_is_answered_any_more() {
    let unsent = Error::Timeout { station: 1, code: Code::ControlPlc, after: Duration::ZERO, sent: false };
    let twice = Error::Plc { station: 1, code: Code::ControlPlc, error: ErrorCode::IllegalFormat, repeated: true };
    let refused = refusal(Code::ControlPlc, ErrorCode::IllegalFormat);
    let options = WriteOptions::new().stop_first().run_again();
    for (step, before, left) in [
        (Step::Stop, PlcState::Running, "nothing was written, and the PLC runs"),
        (Step::Run, PlcState::Stopped, "the program is written, and the PLC ran before and is stopped now"),
    ] {
        for (result, known) in [
            (refused.clone(), true),
            (unsent.clone(), true),
            (twice.clone(), false),
            (timeout(Code::ControlPlc), false),
        ] {
            let mut world = World::new(1, Chances::default());
            world.plc.run();
            let mut writing = at(&mut world, options, step);
            assert_eq!(writing.state().plc, PlcState::Unknown, "abandoned here, it may be on its way");
            writing.told(Err(result));
            // A RUN that was refused is not followed by a question.
            if writing.next() != Step::Failed {
                writing.told(Err(timeout(Code::ReadStatus)));
            }
            assert_eq!(writing.next(), Step::Failed);
            let error = writing.failure();
            assert_eq!(error.state.plc, if known { before } else { PlcState::Unknown }, "{error}");
            assert_eq!(error.to_string().ends_with(left), known, "{error}");
        }
    }
}

#[test]
fn a_stop_that_is_refused_leaves_a_half_that_somebody_runs_running_and_the_error_says_so() {
    let mut world = World::new(2, Chances::default());
    world.plc.stop();
    let mut writing = at(&mut world, WriteOptions::new(), Step::Write(3));
    let program = world.new.clone();
    world.plc.run();
    world.started = true;
    // The page is lost, and so is the question for it: whether the PLC runs is asked, and that is answered.
    writing.told(Err(timeout(Code::WriteProgramPage)));
    writing.told(Err(timeout(Code::ReadProgramPage)));
    world.go(&mut writing, &program);
    assert_eq!(writing.next(), Step::Confirm);
    world.go(&mut writing, &program);
    assert_eq!(writing.next(), Step::Stop);
    writing.told(Err(refusal(Code::ControlPlc, ErrorCode::IllegalFormat)));
    writing.told(Err(timeout(Code::ReadStatus)));
    let error = writing.failure();
    assert_eq!((error.state.plc, &error.state.in_doubt), (PlcState::Running, &vec![3]), "{error}");
    assert!(error.to_string().contains(", page 3 perhaps, and the PLC runs: write the rest before it runs"), "{error}");
}

#[test]
fn a_dry_run_tells_what_a_run_writes_and_fails_where_it_is_refused() {
    let mut refused = 0;
    for seed in seeds(500) {
        let mut world = World::new(seed, Chances::default());
        let mut random = Random::new(seed);
        let mut options = options(&mut random);
        options.stop_first = random.next().is_multiple_of(2);
        world.plc.set_memory_card(random.next().is_multiple_of(8));
        let (program, ran) = (world.new.clone(), world.plc.is_running());
        let mut dry = Writing::new(program.clone(), options);
        dry.begin(Goal::DryRun);
        while !matches!(dry.next(), Step::Done | Step::Failed) {
            assert!(
                matches!(dry.next(), Step::Status | Step::Read(_) | Step::Confirm),
                "seed {seed}: {:?}",
                dry.next()
            );
            world.go(&mut dry, &program);
        }
        let mut real = Writing::new(program, options);
        match world.run(&mut real, MANY).unwrap() {
            Ok(report) => {
                let mut written = report.written;
                written.sort_unstable();
                assert_eq!((dry.next(), dry.state().unwritten), (Step::Done, written), "seed {seed}");
            }
            Err(error) => {
                refused += 1;
                assert_eq!(dry.next(), Step::Failed, "seed {seed}: {error}");
                assert_eq!(dry.failure().to_string(), error.to_string(), "seed {seed}");
                assert_eq!(world.plc.is_running(), ran);
            }
        }
    }
    assert!(refused > 50 || seeds(500).count() < 500, "{refused}");
}
