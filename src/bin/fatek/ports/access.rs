//! Access rights of the device file of a serial port. It is not opened.

use std::fmt;
use std::path::Path;

/// Right to open a port.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) enum Access {
    Granted,
    /// `group`: its members may open the port.
    Denied {
        group: Option<String>,
    },
    /// There is no device file, as in a container without the device.
    Missing,
    /// The system cannot tell without opening it.
    #[default]
    Unknown,
}

impl Access {
    /// Rights to the device file at a path. `root`: the folder with the `etc` of the system.
    #[cfg(target_os = "linux")]
    pub(crate) fn of(path: &Path, root: &Path) -> Self {
        use rustix::fs::{Access as Rights, access};
        use rustix::io::Errno;

        match access(path, Rights::READ_OK | Rights::WRITE_OK) {
            Ok(()) => Self::Granted,
            Err(Errno::NOENT) => Self::Missing,
            Err(Errno::ACCESS | Errno::PERM | Errno::ROFS) => Self::Denied { group: group(path, root) },
            Err(_) => Self::Unknown,
        }
    }

    /// Not known: systems other than Linux show it when the port is opened.
    #[cfg(not(target_os = "linux"))]
    pub(crate) fn of(_: &Path, _: &Path) -> Self {
        Self::Unknown
    }

    /// `None` if it is not known.
    pub(crate) fn is_granted(&self) -> Option<bool> {
        match self {
            Self::Granted => Some(true),
            Self::Denied { .. } | Self::Missing => Some(false),
            Self::Unknown => None,
        }
    }

    /// The reason why there is no access.
    pub(crate) fn reason(&self) -> Option<String> {
        match self {
            Self::Granted | Self::Unknown => None,
            Self::Denied { group: Some(group) } => Some(format!("for the group {group} only")),
            Self::Denied { group: None } => Some("not for this user".to_owned()),
            Self::Missing => Some("no device file".to_owned()),
        }
    }

    /// The way to get access.
    pub(crate) fn remedy(&self) -> Option<String> {
        match self {
            Self::Denied { group: Some(group) } => {
                Some(format!("`sudo usermod -aG {group} $USER`, then log in again, gives access"))
            }
            Self::Denied { group: None } | Self::Granted | Self::Missing | Self::Unknown => None,
        }
    }
}

impl fmt::Display for Access {
    /// A word for a column: `yes`, `no`, `missing`, `unknown`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Granted => "yes",
            Self::Denied { .. } => "no",
            Self::Missing => "missing",
            Self::Unknown => "unknown",
        })
    }
}

/// Name of the group that may read and write a file.
#[cfg(target_os = "linux")]
fn group(path: &Path, root: &Path) -> Option<String> {
    use std::os::unix::fs::MetadataExt;

    let file = std::fs::metadata(path).ok()?;
    // Read and write for the group.
    let of_group = (file.mode() & 0o060 == 0o060).then_some(file.gid())?;
    name_of_group(&std::fs::read_to_string(root.join("etc/group")).ok()?, of_group)
}

/// Name of a group in the text of `/etc/group`. Names with other characters than those of groups are
/// not taken: they would end up in a command. Neither is group 0: its members have the rights of the
/// superuser.
#[cfg(target_os = "linux")]
fn name_of_group(groups: &str, number: u32) -> Option<String> {
    let name = groups.lines().find_map(|line| {
        let mut fields = line.split(':');
        let (name, _password, id) = (fields.next()?, fields.next()?, fields.next()?);
        (number != 0 && id.parse() == Ok(number)).then_some(name)
    })?;
    let is_plain = name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c));
    (is_plain && !name.starts_with('-')).then(|| name.to_owned())
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn the_group_of_a_number_is_found_by_its_name() {
        let groups = "root:x:0:\nbroken\ndialout:x:20:ann\nbad name;rm:x:21:\n-x:x:22:\n";
        assert_eq!(name_of_group(groups, 20).as_deref(), Some("dialout"));
        for number in [0, 1, 21, 22] {
            assert_eq!(name_of_group(groups, number), None, "{number}");
        }
    }

    #[test]
    fn texts_say_who_has_access() {
        let denied = Access::Denied { group: Some("dialout".to_owned()) };
        assert_eq!(denied.to_string(), "no");
        assert_eq!(denied.reason().as_deref(), Some("for the group dialout only"));
        assert!(denied.remedy().is_some_and(|remedy| remedy.contains("usermod -aG dialout")));
        assert_eq!((Access::Granted.to_string().as_str(), Access::Granted.is_granted()), ("yes", Some(true)));
        assert_eq!((Access::Unknown.is_granted(), Access::Missing.is_granted()), (None, Some(false)));
        assert_eq!(Access::of(Path::new("/nowhere/ttyX"), Path::new("/")), Access::Missing);
    }
}
