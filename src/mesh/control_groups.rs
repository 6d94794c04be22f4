//! Memory limits of the control groups (versions 1 and 2) of this process.
//!
//! Containers, batch systems and service managers set these limits. The system kills a process that
//! exceeds one.

use std::fs;
use std::path::{Path, PathBuf};

/// File and key names of one version of control groups.
struct Version {
    /// Files of the limits, bytes. Without a limit they contain "max" or a number above any memory
    /// size.
    limits: &'static [&'static str],
    used: &'static str,
    /// Keys of the page cache in `memory.stat`. These pages count as used, but the system can
    /// reclaim them.
    files: [&'static str; 2],
}

const FIRST: Version = Version {
    limits: &["memory.limit_in_bytes"],
    used: "memory.usage_in_bytes",
    files: ["total_active_file", "total_inactive_file"],
};
const SECOND: Version = Version {
    limits: &["memory.max", "memory.high"],
    used: "memory.current",
    files: ["active_file", "inactive_file"],
};

/// Returns the number of bytes that this process may still use under its control group limits.
///
/// The result is the minimum over its group and all ancestors. Returns `None` if there are no
/// groups. `root` is `/`, except in tests.
pub(super) fn available(root: &Path) -> Option<u64> {
    let own = fs::read_to_string(root.join("proc/self/cgroup")).ok()?;
    let mounts = fs::read_to_string(root.join("proc/self/mountinfo")).ok()?;
    mounts
        .lines()
        .filter_map(|line| {
            let (mount, kind) = line.split_once(" - ")?;
            let mut mount = mount.split(' ').skip(3);
            let (top, point) = (mount.next()?, mount.next()?);
            let mut kind = kind.split(' ');
            let version = match (kind.next()?, kind.nth(1)?) {
                ("cgroup2", _) => SECOND,
                ("cgroup", options) if options.split(',').any(|o| o == "memory") => FIRST,
                _ => return None,
            };
            let group = group_of(&own, &version)?;
            // In a container, the mount may begin below the root of the hierarchy.
            let below = Path::new(group).strip_prefix(top).unwrap_or(Path::new(""));
            let point = root.join(point.trim_start_matches('/'));
            least(&point, &point.join(below), &version)
        })
        .min()
}

/// Returns the group of this process from lines of the form `number:controllers:path`.
fn group_of<'a>(own: &'a str, version: &Version) -> Option<&'a str> {
    own.lines().find_map(|line| {
        let mut parts = line.splitn(3, ':').skip(1);
        let (controllers, path) = (parts.next()?, parts.next()?);
        let is_it = match version.used == SECOND.used {
            true => controllers.is_empty(),
            false => controllers.split(',').any(|name| name == "memory"),
        };
        is_it.then_some(path)
    })
}

/// Returns the fewest bytes still available in a group and its ancestors, up to `top`.
fn least(top: &Path, group: &Path, version: &Version) -> Option<u64> {
    let groups = group.ancestors().take_while(|group| group.starts_with(top));
    groups.filter_map(|group| left(group, version)).min()
}

fn left(group: &Path, version: &Version) -> Option<u64> {
    let number = |name: &str| number(&group.join(name));
    let limit = version
        .limits
        .iter()
        .filter_map(|name| number(name))
        .min()?;
    let used = number(version.used)?;
    let stat = fs::read_to_string(group.join("memory.stat")).unwrap_or_default();
    let entries = stat.lines().filter_map(|line| line.split_once(' '));
    let of_files = entries.filter(|(name, _)| version.files.contains(name));
    let of_files: u64 = of_files.filter_map(|(_, n)| n.parse::<u64>().ok()).sum();
    Some(limit.saturating_sub(used.saturating_sub(of_files)))
}

fn number(file: &PathBuf) -> Option<u64> {
    fs::read_to_string(file).ok()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        root
    }

    #[test]
    fn the_least_that_a_group_or_one_above_it_leaves_counts() {
        let second = [
            ("proc/self/cgroup", "0::/a/b\n"),
            (
                "proc/self/mountinfo",
                "26 20 0:22 / /proc rw - proc proc rw\n\
                 30 20 0:26 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n",
            ),
            ("sys/fs/cgroup/a/memory.max", "5000\n"),
            ("sys/fs/cgroup/a/memory.current", "4000\n"),
            (
                "sys/fs/cgroup/a/memory.stat",
                "anon 900\nactive_file 1000\ninactive_file 2000\n",
            ),
            ("sys/fs/cgroup/a/b/memory.max", "max\n"),
            ("sys/fs/cgroup/a/b/memory.current", "10\n"),
        ];
        assert_eq!(available(machine(&second).path()), Some(4000));
        let high = [&second[..], &[("sys/fs/cgroup/a/b/memory.high", "300\n")]].concat();
        assert_eq!(available(machine(&high).path()), Some(290));
        let exceeded = [&second[..], &[("sys/fs/cgroup/a/memory.max", "500\n")]].concat();
        assert_eq!(available(machine(&exceeded).path()), Some(0));

        // A container sees its group, /x/y on the host, as the root of the mount.
        let first = [
            (
                "proc/self/cgroup",
                "4:cpu,memory:/x/y/z\n1:name=systemd:/\n0::/\n",
            ),
            (
                "proc/self/mountinfo",
                "31 20 0:27 /x/y /sys/fs/cgroup/memory rw - cgroup cgroup rw,cpu,memory\n",
            ),
            ("sys/fs/cgroup/memory/z/memory.limit_in_bytes", "700\n"),
            ("sys/fs/cgroup/memory/z/memory.usage_in_bytes", "600\n"),
            (
                "sys/fs/cgroup/memory/memory.limit_in_bytes",
                "9223372036854771712\n",
            ),
            ("sys/fs/cgroup/memory/memory.usage_in_bytes", "600\n"),
        ];
        assert_eq!(available(machine(&first).path()), Some(100));
        assert_eq!(available(machine(&[]).path()), None);
    }
}
