//! Ports are pseudo-terminals. A port that comes and goes has a symbolic link as its path.
//!
//! Linux only: macOS refuses a baud rate for them.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use fatek::endpoint::{DataBits, Parity, StopBits};
use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
use fatek::{Endpoint, LinkState, Value};
use rustix::termios::{ControlModes, InputModes, LocalModes, OutputModes, Termios, tcgetattr};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_serial::{SerialPort as _, SerialStream};

use super::*;

/// Longer than any step takes, even on a busy machine.
const LONG: Duration = Duration::from_secs(10);

/// A path at which ports are plugged and unplugged.
struct Socket {
    directory: PathBuf,
}

impl Socket {
    fn new(test: &str) -> Self {
        let directory = std::env::temp_dir().join(format!("fatek-{test}-{}", std::process::id()));
        std::fs::create_dir_all(&directory).unwrap();
        Self { directory }
    }

    fn path(&self) -> PathBuf {
        self.directory.join("port")
    }

    fn plug(&self, port: &Path) {
        let new = self.directory.join("new");
        std::os::unix::fs::symlink(port, &new).unwrap();
        std::fs::rename(new, self.path()).unwrap();
    }

    fn unplug(&self) {
        std::fs::remove_file(self.path()).unwrap();
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.directory);
    }
}

/// A serial adapter with PLCs behind it.
struct Adapter {
    path: PathBuf,
    /// Keeps the port open: a line needs both sides open.
    port: File,
    plcs: JoinHandle<()>,
}

impl Adapter {
    fn new(bus: Bus, framing: Framing) -> Self {
        let (line, port) = SerialStream::pair().unwrap();
        let path = PathBuf::from(port.name().unwrap());
        let port = File::open(&path).unwrap();
        let plcs = tokio::spawn(async move { drop(sim::serve(line, bus, framing).await) });
        Self { path, port, plcs }
    }

    fn endpoint(&self) -> Endpoint {
        Endpoint::serial(self.path.to_str().unwrap())
    }

    fn settings(&self) -> Termios {
        tcgetattr(&self.port).unwrap()
    }

    /// Removes the adapter and its line.
    async fn unplug(self) {
        self.plcs.abort();
        let _ = self.plcs.await;
    }
}

fn bus(plc: &Plc) -> Bus {
    Bus::new().with_station(1, plc.clone()).unwrap()
}

#[tokio::test]
async fn a_value_written_is_read_back_in_both_framings() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let adapter = Adapter::new(bus(&Plc::new()), framing);
        let fast = SerialSettings::new(framing).with_baud(115_200).unwrap();
        let endpoint = adapter.endpoint().with_framing(framing).with_serial(fast).unwrap();
        let link = Link::builder(endpoint).response_timeout(LONG).build();
        let station = link.station(1).unwrap();
        let values: Vec<u16> = (0..64).map(|n| n * 0x0101).collect();
        station.write_registers(register!("R0"), &values).await.unwrap();
        assert_eq!(station.read_registers(register!("R0"), 64).await.unwrap(), values);
        link.close().await;
        adapter.unplug().await;
    }
}

#[tokio::test]
async fn an_echoing_adapter_is_recognised_and_its_echo_is_no_reply() {
    for (mode, echoes) in
        [(EchoMode::Auto, true), (EchoMode::Auto, false), (EchoMode::On, true), (EchoMode::Off, false)]
    {
        let plc = Plc::new();
        plc.run();
        let faults = Faults::new(1);
        if echoes {
            faults.add_rule(Rule::new(Fault::Echo));
        }
        let adapter = Adapter::new(bus(&plc).with_faults(faults.clone()), Framing::Ascii);
        let link = Link::builder(adapter.endpoint()).response_timeout(LONG).echo(mode).build();
        let station = link.station(1).unwrap();
        // The right replies to these calls equal their requests.
        station.stop().await.unwrap();
        station.loop_back("ABCDEFG").await.unwrap();
        assert_eq!(station.read_registers(register!("R0"), 2).await.unwrap(), [0, 0]);
        assert!(!plc.is_running());
        let stats = link.stats();
        assert_eq!(stats.echoes, if echoes { faults.log().arrivals() } else { 0 }, "{mode:?}, {echoes}");
        assert_eq!((stats.stations.timeouts, stats.stations.stray_frames), (0, 0), "{mode:?}, {echoes}");
        link.close().await;
        adapter.unplug().await;
    }
}

/// A pseudo-terminal always has 8 data bits and no parity bit. It keeps the speed, the stop
/// bits, the kind of parity, and whether parity is checked.
#[tokio::test]
async fn a_port_has_the_settings_of_its_endpoint() {
    let ascii = SerialSettings::new(Framing::Ascii);
    let odd = ascii.with_baud(57_600).unwrap().with_parity(Parity::Odd).with_stop_bits(StopBits::Two);
    let (even, none) = ((false, true), (false, false));
    for (framing, settings, baud, two_stop_bits, parity) in [
        (Framing::Ascii, None, 9600, false, even),
        (Framing::Binary, None, 9600, false, none),
        (Framing::Ascii, Some(odd), 57_600, true, (true, true)),
        (Framing::Binary, Some(odd.with_data_bits(DataBits::Eight)), 57_600, true, (true, true)),
    ] {
        let adapter = Adapter::new(bus(&Plc::new()), framing);
        let mut endpoint = adapter.endpoint().with_framing(framing);
        if let Some(settings) = settings {
            endpoint = endpoint.with_serial(settings).unwrap();
        }
        let link = Link::builder(endpoint.clone()).response_timeout(LONG).build();
        link.station(1).unwrap().read_status().await.unwrap();

        let set = adapter.settings();
        assert_eq!((set.input_speed(), set.output_speed()), (baud, baud), "{endpoint}");
        assert_eq!(set.control_modes.contains(ControlModes::CSTOPB), two_stop_bits, "{endpoint}");
        let is_odd = set.control_modes.contains(ControlModes::PARODD);
        let is_checked = set.input_modes.contains(InputModes::INPCK);
        assert_eq!((is_odd, is_checked), parity, "{endpoint}");
        assert!(!set.control_modes.contains(ControlModes::CRTSCTS), "no flow control");
        assert!(!set.input_modes.intersects(InputModes::IXON | InputModes::IXOFF | InputModes::ICRNL));
        assert!(!set.output_modes.contains(OutputModes::OPOST), "bytes are passed unchanged");
        assert!(!set.local_modes.intersects(LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG));
        link.close().await;
        adapter.unplug().await;
    }
}

/// Log of this program. Ports are opened on threads of their own, so all tests share one log.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl std::io::Write for Log {
    fn write(&mut self, text: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(text);
        Ok(text.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[tokio::test]
async fn a_port_that_ignores_its_settings_is_logged_as_a_warning() {
    let log = Log::default();
    let writer = log.clone();
    tracing_subscriber::fmt().with_ansi(false).with_writer(move || writer.clone()).init();
    // A pseudo-terminal always has 8 data bits and no parity.
    for (framing, warned) in [(Framing::Ascii, true), (Framing::Binary, false)] {
        let adapter = Adapter::new(bus(&Plc::new()), framing);
        let endpoint = adapter.endpoint().with_framing(framing);
        let link = Link::builder(endpoint).response_timeout(LONG).build();
        link.station(1).unwrap().read_status().await.unwrap();
        link.close().await;
        // A later port may reuse the name of a closed one.
        let text = String::from_utf8(std::mem::take(&mut *log.0.lock().unwrap())).unwrap();
        let path = format!("port=\"{}\"", adapter.path.display());
        let warning = text.lines().find(|line| line.contains("does not keep its settings") && line.contains(&path));
        assert_eq!(warning.is_some(), warned, "{framing}: {text}");
        adapter.unplug().await;
    }
}

#[tokio::test]
async fn bytes_from_before_the_port_was_opened_are_discarded() {
    let (mut line, port) = SerialStream::pair().unwrap();
    line.write_all(b"\x020146077777D4\x03 and more").await.unwrap();
    while port.bytes_to_read().unwrap() == 0 {
        tokio::task::yield_now().await;
    }
    let endpoint = Endpoint::serial(port.name().unwrap());
    let link = Link::builder(endpoint).response_timeout(LONG).build();
    let plcs = tokio::spawn(sim::serve(line, bus(&Plc::new()), Framing::Ascii));
    link.station(1).unwrap().read_status().await.unwrap();
    let stats = link.stats();
    assert_eq!((stats.stale_bytes, stats.garbage_bytes, stats.stations.stray_frames), (0, 0, 0));
    plcs.abort();
}

#[tokio::test]
async fn a_port_is_opened_by_one_link_only() {
    let adapter = Adapter::new(bus(&Plc::new()), Framing::Ascii);
    let builder = || Link::builder(adapter.endpoint()).response_timeout(LONG).fail_fast(true);
    let (first, second) = (builder().build(), builder().build());
    first.station(1).unwrap().read_status().await.unwrap();
    let error = second.station(1).unwrap().read_status().await.unwrap_err();
    assert!(matches!(error, Error::Connect { .. }), "{error:?}");
    first.close().await;
    second.station(1).unwrap().read_status().await.unwrap();
}

#[tokio::test]
async fn an_unplugged_port_fails_calls_and_is_reopened_when_back() {
    let socket = Socket::new("replug");
    let adapter = Adapter::new(bus(&Plc::new()), Framing::Ascii);
    socket.plug(&adapter.path);
    let endpoint = Endpoint::serial(socket.path().to_str().unwrap());
    let link = Link::builder(endpoint.clone())
        .options(CallOptions::new().with_response_timeout(LONG).with_call_timeout(2 * LONG))
        .connect_backoff(Duration::from_millis(10), Duration::from_millis(50))
        .build();
    let station = link.station(1).unwrap();
    assert_eq!(station.read_registers(register!("R0"), 1).await.unwrap(), [0]);

    // Station 2 does not exist, so this call stays queued or in flight.
    let absent = link.station(2).unwrap();
    let absent = absent.with_options(absent.options().with_retries(0));
    let sent = link.stats().stations.requests + link.stats().stations.checks;
    let waiting = tokio::spawn(async move { absent.write_registers(register!("R0"), &[5]).await });
    let is_sent = async {
        while link.stats().stations.requests + link.stats().stations.checks == sent {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    timeout(LONG, is_sent).await.unwrap();
    socket.unplug();
    adapter.unplug().await;
    let error = timeout(LONG / 2, waiting).await.expect("the call fails before its timeout").unwrap().unwrap_err();
    assert!(matches!(error, Error::Disconnected { .. }), "{error:?}");

    let short_deadline = station.with_options(CallOptions::new().with_call_timeout(Duration::from_millis(100)));
    let error = short_deadline.read_registers(register!("R0"), 1).await.unwrap_err();
    assert!(matches!(error, Error::Connect { .. }), "{error:?}");
    assert!(error.to_string().starts_with(&format!("cannot connect to {endpoint}: ")), "{error}");
    assert!(matches!(link.state(), LinkState::Down { .. } | LinkState::Connecting));

    // Another PLC at the same path.
    let (first, second) = (Plc::new(), Plc::new());
    let adapter = Adapter::new(bus(&first).with_station(2, second.clone()).unwrap(), Framing::Ascii);
    socket.plug(&adapter.path);
    station.write_registers(register!("R0"), &[7]).await.unwrap();
    assert_eq!(first.read(register!("R0")), Value::Word(7));
    assert_eq!(second.read(register!("R0")), Value::Word(0), "the write in flight is not repeated");
    link.close().await;
    adapter.unplug().await;
}

/// Reads a register of a line where nothing answers.
async fn read(url: &str) -> (Link, Error) {
    let options = CallOptions::new().with_call_timeout(Duration::from_millis(200)).with_retries(0);
    let endpoint: Endpoint = url.parse().unwrap();
    let link = Link::builder(endpoint).fail_fast(true).build();
    let station = link.station(1).unwrap().with_options(options);
    let error = station.read_registers(register!("R0"), 1).await.unwrap_err();
    (link, error)
}

/// Also the superuser, who may open a port that is in use: the lock is advisory.
#[tokio::test]
async fn a_port_is_used_by_one_link_at_a_time() {
    let adapter = Adapter::new(Bus::new(), Framing::Ascii);
    let url = adapter.endpoint().to_string();
    let (first, error) = read(&url).await;
    assert!(error.is_timeout(), "{error}");
    let (_, error) = read(&url).await;
    assert!(error.is_connect() && error.to_string().contains("lock"), "{error}");
    first.close().await;
    let (_, error) = read(&url).await;
    assert!(error.is_timeout(), "the port is free: {error}");
}

/// Pseudo-terminals have no such lines; with a port double, see the tests of the transport.
#[tokio::test]
async fn options_of_lines_reach_the_port() {
    for (option, line) in [("dtr=on", "DTR"), ("rts=off", "RTS"), ("rs485=rts", "RTS"), ("rs485=rts-inverted", "RTS")] {
        let adapter = Adapter::new(Bus::new(), Framing::Ascii);
        let (_, error) = read(&format!("{}?{option}", adapter.endpoint())).await;
        let text = error.to_string();
        assert!(error.is_connect() && text.contains(&format!("the line {line} of the port cannot be set")), "{text}");
    }
}
