//! Single steps: STOP and RUN that fail, and dry runs.

use super::*;

/// A writing whose next step is such a request, with replies to all before.
fn at(world: &mut World, options: WriteOptions, is_next: impl Fn(&Request) -> bool) -> Writing {
    let mut writing = Writing::new(world.new.clone(), options);
    writing.begin(WriteGoal::Write);
    loop {
        match writing.next().unwrap() {
            Step::Send(request) if is_next(&request) => return writing,
            Step::Send(_) | Step::Confirm => world.go(&mut writing),
            Step::Done => panic!("the request never comes"),
        }
    }
}

#[test]
fn a_refused_or_unsent_stop_or_run_leaves_a_known_state() {
    let unsent = Error::timeout(1, Code::ControlPlc, Duration::ZERO, false);
    let twice = Error::Plc { station: 1, code: Code::ControlPlc, error: ErrorCode::IllegalFormat, repeated: true };
    let refused = refusal(Code::ControlPlc, ErrorCode::IllegalFormat);
    let options = WriteOptions::new().stop_first(true).run_again(true);
    for (command, before, left) in [
        (Request::Stop, PlcState::Running, "nothing was written, and the PLC runs"),
        (Request::Run, PlcState::Stopped, "the program is written, and the PLC ran before and is stopped now"),
    ] {
        for (result, known) in [
            (refused.clone(), true),
            (unsent.clone(), true),
            (twice.clone(), false),
            (timeout(Code::ControlPlc), false),
        ] {
            let mut world = World::new(1, Chances::default());
            world.plc.run();
            let mut writing = at(&mut world, options, |request| *request == command);
            assert_eq!(writing.state().plc, PlcState::Unknown, "dropped here, it may be on its way");
            writing.handle(Err(result)).unwrap();
            // No status is read after a RUN that was refused.
            let failure = writing.next().err();
            let source = failure.unwrap_or_else(|| {
                writing.handle(Err(timeout(Code::ReadStatus))).unwrap();
                writing.next().unwrap_err()
            });
            let error = failed(&writing, source);
            assert_eq!(error.state.plc, if known { before } else { PlcState::Unknown }, "{error}");
            assert_eq!(error.to_string().ends_with(left), known, "{error}");
        }
    }
}

#[test]
fn a_refused_stop_leaves_a_half_written_plc_running() {
    let mut world = World::new(2, Chances::default());
    world.plc.stop();
    let mut writing =
        at(&mut world, WriteOptions::new(), |request| matches!(request, Request::WritePage { page: 3, .. }));
    world.plc.run();
    world.started = true;
    // The page is lost, and so is its read. The status has a reply.
    writing.handle(Err(timeout(Code::WriteProgramPage))).unwrap();
    writing.handle(Err(timeout(Code::ReadProgramPage))).unwrap();
    world.go(&mut writing);
    assert_eq!(writing.next().unwrap(), Step::Confirm);
    world.go(&mut writing);
    assert_eq!(writing.next().unwrap(), Step::Send(Request::Stop));
    writing.handle(Err(refusal(Code::ControlPlc, ErrorCode::IllegalFormat))).unwrap();
    writing.handle(Err(timeout(Code::ReadStatus))).unwrap();
    let source = writing.next().unwrap_err();
    let error = failed(&writing, source);
    assert_eq!((error.state.plc, &error.state.in_doubt), (PlcState::Running, &vec![3]), "{error}");
    assert!(error.to_string().contains(", page 3 perhaps, and the PLC runs: write the rest before it runs"), "{error}");
}

#[test]
fn a_dry_run_ends_as_a_run_would() {
    let mut refused = 0;
    for seed in seeds(500) {
        let mut world = World::new(seed, Chances::default());
        let mut random = Random::new(seed);
        let mut options = options(&mut random);
        options.stop_first = random.next().is_multiple_of(2);
        world.plc.set_memory_card(random.next().is_multiple_of(8));
        let (program, ran) = (world.new.clone(), world.plc.is_running());
        let mut dry = Writing::new(program.clone(), options);
        dry.begin(WriteGoal::DryRun);
        let dry_end = loop {
            match dry.next() {
                Ok(Step::Done) => break Ok(dry.state().unwritten),
                Ok(Step::Send(request)) if is_command(&request) || request == Request::Status => {
                    panic!("seed {seed}: {request:?}")
                }
                Ok(Step::Send(_) | Step::Confirm) => world.go(&mut dry),
                Err(source) => break Err(failed(&dry, source)),
            }
        };
        let mut real = Writing::new(program, options);
        match world.run(&mut real, MANY).unwrap() {
            Ok(report) => {
                let mut written = report.written;
                written.sort_unstable();
                assert_eq!(dry_end.unwrap(), written, "seed {seed}");
            }
            Err(error) => {
                refused += 1;
                assert_eq!(dry_end.unwrap_err().to_string(), error.to_string(), "seed {seed}");
                assert_eq!(world.plc.is_running(), ran);
            }
        }
    }
    assert!(refused > 50 || seeds(500).count() < 500, "{refused}");
}
