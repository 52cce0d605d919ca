//! Structs of tags: read, written, planned and polled.

use std::time::Duration;

use fatek::plan::{CostModel, Limits, StructPlan};
use fatek::poll::{NotCurrent, Poller, Quality, ScanClass};
use fatek::sim::{self, Fault, Rule};
use fatek::tag::TagValue;
use fatek::{Error, Tags, discrete, element, register};

#[derive(Clone, Debug, PartialEq, Tags)]
struct Tank {
    #[tag("R100:f32")]
    level: f32,
    #[tag("R5:i16*0.1-40")]
    temperature: f64,
    #[tag("DR20", one_scan)]
    batches: u32,
    #[tag("Y0-Y3", one_scan)]
    valves: [bool; 4],
    #[tag("R30-R34:text")]
    recipe: String,
    #[tag("R7.3", read_only)]
    pump_runs: bool,
    #[tag("X4", read_only)]
    door_is_open: bool,
}

fn full() -> Tank {
    Tank {
        level: 2.75,
        temperature: 21.5,
        batches: 70_000,
        valves: [true, false, true, true],
        recipe: "lemonade".to_owned(),
        pump_runs: true,
        door_is_open: true,
    }
}

#[tokio::test(start_paused = true)]
async fn a_struct_is_written_and_read_as_a_whole() {
    let bench = sim::station().await;
    let station = &bench.station;
    bench.plc.write(register!("R7"), 0x0008_u16).unwrap();
    bench.plc.write(discrete!("X4"), true).unwrap();
    station.write_struct(&full()).await.unwrap();
    assert_eq!(station.read_struct::<Tank>().await.unwrap(), full());
    // The fields that are read only were not written.
    station.write_struct(&Tank { pump_runs: false, door_is_open: false, ..full() }).await.unwrap();
    assert_eq!(station.read_struct::<Tank>().await.unwrap(), full());
    let error = station.write_struct(&Tank { temperature: 1e9, ..full() }).await.unwrap_err();
    assert_eq!(
        error.to_string(),
        "1000000000.0 cannot be written to R5:i16*0.1-40 (scaled): the raw number of 1000000000.0 is 10000000400.0, out \
         of range: i16 takes -32768 to 32767"
    );
}

#[test]
fn fields_have_the_options_of_their_attributes() {
    let fields: Vec<_> =
        Tank::FIELDS.iter().map(|it| (it.name(), it.tag().to_string(), it.one_scan(), it.is_read_only())).collect();
    assert_eq!(
        fields,
        [
            ("level", "R100:f32".to_owned(), None, false),
            ("temperature", "R5:i16*0.1-40".to_owned(), None, false),
            ("batches", "DR20".to_owned(), Some(""), false),
            ("valves", "Y0-Y3".to_owned(), Some(""), false),
            ("recipe", "R30-R34:text".to_owned(), None, false),
            ("pump_runs", "R7.3".to_owned(), None, true),
            ("door_is_open", "X4".to_owned(), None, true),
        ]
    );
    let written: Vec<_> = full().assignments().unwrap().iter().map(ToString::to_string).collect();
    assert_eq!(
        written,
        ["R100:f32=2.75", "R5:i16*0.1-40=21.5", "DR20=70000", "Y0-Y3=1,0,1,1", "R30-R34:text=\"lemonade\""]
    );
}

#[tokio::test(start_paused = true)]
async fn fields_of_a_group_come_from_one_request() {
    let bench = sim::station().await;
    let cost = CostModel::of_link(bench.station.link());
    let plan = StructPlan::<Tank>::new(cost).unwrap();
    let requests = plan.as_plan().requests();
    let of_group = requests.iter().filter(|request| {
        let text = request.request().to_string();
        text.contains("DR20") && text.contains("Y0")
    });
    assert_eq!(of_group.count(), 1, "{requests:?}");
    bench.plc.write(element!("DR20"), 7_u32).unwrap();
    assert_eq!(plan.read(&bench.station).await.unwrap().batches, 7);

    #[derive(Debug, Tags)]
    struct TooLong {
        #[tag("R0-R63", one_scan = "a")]
        _registers: Vec<u16>,
        #[tag("D0", one_scan = "a")]
        _more: u16,
    }
    let error = bench.station.read_struct::<TooLong>().await.unwrap_err();
    assert!(matches!(error, Error::Tag(_)), "{error}");
    let limits = Limits::new().readable(element!("R0"), element!("R99")).unwrap();
    let error = StructPlan::<Tank>::with_limits(cost, limits).unwrap_err();
    assert!(error.to_string().starts_with("the tags cannot be read: "), "{error}");
}

/// An own type, whose fit is found at run time.
#[derive(Clone, Debug)]
struct Percent(#[expect(dead_code, reason = "printed")] u16);

impl fatek::tag::FromTag for Percent {
    fn type_name() -> String {
        "Percent".to_owned()
    }

    fn from_values(values: &[TagValue]) -> Option<Self> {
        match values {
            [TagValue::U16(value)] => Some(Self(*value)),
            _ => None,
        }
    }
}

#[derive(Debug, Tags)]
struct Misfit {
    #[tag("R0", read_only)]
    _good: Percent,
    #[tag("R1:f32", read_only)]
    _misfit: Percent,
}

#[tokio::test(start_paused = true)]
async fn own_types_are_checked_before_anything_is_sent() {
    let bench = sim::station().await;
    let error = bench.station.read_struct::<Misfit>().await.unwrap_err();
    assert_eq!(error.to_string(), "R1:f32 (f32 of 32 bits) cannot be read into `Percent`");
    let poller = Poller::new();
    let polled = poller.station(&bench.station).unwrap();
    let class = ScanClass::every(Duration::from_secs(1));
    assert_eq!(polled.add_struct::<Misfit>(class, "misfit").unwrap_err().to_string(), error.to_string());
    assert_eq!(bench.log().arrivals(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_struct_is_polled() {
    let bench = sim::station().await;
    bench.station.write_struct(&full()).await.unwrap();
    let poller = Poller::new();
    let polled = poller.station(&bench.station).unwrap();
    let tank = polled.add_struct::<Tank>(ScanClass::every(Duration::from_secs(1)), "tank").unwrap();
    let error = tank.latest().unwrap_err();
    assert_eq!(error.to_string(), "tank.level is bad: not read yet");
    tokio::time::sleep(Duration::from_secs(3)).await;
    let expected = Tank { pump_runs: false, door_is_open: false, ..full() };
    assert_eq!(tank.latest().unwrap(), expected);
    let names: Vec<_> = polled.snapshot().iter().map(|sample| sample.name.to_string()).collect();
    assert!(names.iter().any(|name| name == "tank.door_is_open") && names.len() == 7, "{names:?}");
    assert_eq!(tank.ids().len(), 7);

    // The PLC falls silent: no value is returned as if it were current.
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    tokio::time::sleep(Duration::from_secs(20)).await;
    let error = tank.latest().unwrap_err();
    assert!(matches!(error, NotCurrent::Field { quality: Quality::Stale(_) | Quality::Bad(_), .. }), "{error}");
    assert!(error.to_string().starts_with("tank.level is "), "{error}");

    tank.remove();
    assert!(polled.snapshot().is_empty());
}

#[tokio::test(start_paused = true)]
async fn no_tag_of_a_struct_is_polled_if_one_group_is_refused() {
    #[derive(Debug, Tags)]
    struct TooLong {
        #[tag("M5")]
        _alarm: bool,
        #[tag("R0-R63", one_scan)]
        _registers: Vec<u16>,
        #[tag("D0", one_scan)]
        _more: u16,
    }
    let bench = sim::station().await;
    let poller = Poller::new();
    let polled = poller.station(&bench.station).unwrap();
    let class = ScanClass::every(Duration::from_secs(1));
    assert!(polled.add_struct::<TooLong>(class, "tank").is_err());
    assert!(polled.snapshot().is_empty());
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert_eq!(bench.log().arrivals(), 0);
}
