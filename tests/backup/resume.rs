//! Resumed backups: they continue only with the PLC with which they began.

use fatek::backup::{Backup, BackupError, TakeBackup};
use fatek::sim::{Fault, Faults, Model, Rule};
use fatek::wire::Framing;
use fatek::{ErrorCode, command::Code};

use crate::bench::{Bench, FRAMINGS, model, tags};

/// Half a backup of a PLC of this model, from a file.
async fn partial(framing: Framing, model: Model) -> Backup {
    let bench = Bench::with_model(framing, Faults::new(1), model);
    // The second request has no reply; the check of the first one has.
    bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::ReadRegisters).skip(1)]);
    let error = bench.station().back_up(tags(["R0-R99"])).await.unwrap_err();
    let BackupError::Call { partial, .. } = error else { panic!("{error}") };
    assert_eq!(partial.value_count(), 64);
    Backup::from_file(partial.to_file().as_bytes()).unwrap()
}

#[tokio::test(start_paused = true)]
async fn a_backup_does_not_resume_with_another_station() {
    for framing in FRAMINGS {
        let partial = partial(framing, model()).await;
        let bench = Bench::new(framing, Faults::new(1));
        let other = bench.station().link().station(2).unwrap();
        let mut taking = TakeBackup::resume(partial.clone());
        let error = taking.run(&other).await.unwrap_err();
        assert!(matches!(error, BackupError::OtherStation { backup: 1, station: 2, .. }), "{error}");
        assert_eq!(error.to_string(), "the backup was begun with station 1, and cannot continue with station 2");
        assert_eq!((bench.faults.log().arrivals(), taking.partial()), (0, &partial));
        // With the right station it continues.
        assert!(taking.run(&bench.station()).await.unwrap().is_complete());
        // An empty backup continues with any PLC.
        let unread = Backup::of(tags(["R0"])).unwrap();
        assert!(TakeBackup::resume(unread).run(&bench.station()).await.unwrap().is_complete());
    }
}

#[tokio::test(start_paused = true)]
async fn a_backup_does_not_resume_with_another_model() {
    for framing in FRAMINGS {
        let partial = partial(framing, model().main_unit(1).io_points_code(3)).await;
        for (other, message) in [
            (model().main_unit(0).io_points_code(3), "main unit MA/MU, I/O points code 3"),
            (model().main_unit(1).io_points_code(4), "main unit MC, I/O points code 4"),
        ] {
            let bench = Bench::with_model(framing, Faults::new(1), other);
            let mut taking = TakeBackup::resume(partial.clone());
            let error = taking.run(&bench.station()).await.unwrap_err();
            assert!(matches!(error, BackupError::OtherPlc { .. }), "{error}");
            let begun =
                "the backup was begun with another PLC (main unit MC, I/O points code 3), and cannot continue with";
            assert_eq!(error.to_string(), format!("{begun} this one ({message})"));
            // The check of the new connection, and 53.
            assert_eq!((bench.faults.log().arrivals(), taking.partial()), (2, &partial));
        }
        // A PLC that does not report its type, unlike the first one.
        let bench = Bench::new(framing, Faults::new(1));
        bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(Code::ReadDetailedStatus)]);
        let error = TakeBackup::resume(partial.clone()).run(&bench.station()).await.unwrap_err();
        assert!(
            error.to_string().ends_with("cannot continue with this one (which does not report its type)"),
            "{error}"
        );
        // A later version of the same is the same.
        let same = model().main_unit(1).io_points_code(3).os_version(4, 2);
        let bench = Bench::with_model(framing, Faults::new(1), same);
        assert!(TakeBackup::resume(partial).run(&bench.station()).await.unwrap().is_complete());
    }
}
