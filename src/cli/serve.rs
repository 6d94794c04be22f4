use super::{Output, STOP};
use crate::error::input_file;
use crate::error::{Error, Result};
use crate::mesh::memory;
use crate::service::{self, JobLimits, Service, Settings};
use rustix::fs::Mode;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use tracing::Level;

#[derive(clap::Args)]
pub struct Arguments {
    /// Address and port to listen on; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8787")]
    listen: SocketAddr,
    /// Folder for files and jobs
    #[arg(long, value_name = "DIR", default_value = "lasertrace-store")]
    store: PathBuf,
    /// File with the token that clients must send; alternatively, set the variable LASERTRACE_TOKEN
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Host name by which clients call this machine, in addition to localhost; may be repeated
    #[arg(long, value_name = "NAME")]
    host: Vec<String>,
    /// Number of jobs that run in parallel
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=1000))]
    jobs: u16,
    /// Maximum number of waiting jobs
    #[arg(long, value_name = "N", default_value_t = 1000)]
    queue: u32,
    /// Maximum size of an uploaded file, MB
    #[arg(long, value_name = "MB", default_value_t = 4096, value_parser = megabytes())]
    file_mb: u64,
    /// Memory limit per job, MB [default: available memory divided by the number of parallel jobs]
    #[arg(long, value_name = "MB", value_parser = megabytes())]
    job_memory_mb: Option<u64>,
    /// Time limit per job, s
    #[arg(long, value_name = "S", default_value_t = 24 * 3600, value_parser = clap::value_parser!(u64).range(1..=1 << 32))]
    job_seconds: u64,
    /// Maximum size of a file written by a job, MB
    #[arg(long, value_name = "MB", default_value_t = 16384, value_parser = megabytes())]
    job_file_mb: u64,
}

fn megabytes() -> clap::builder::RangedU64ValueParser<u64> {
    clap::value_parser!(u64).range(1..=1 << 32)
}

/// Address space in bytes, if the system does not report the available memory.
const MEMORY: u64 = 4_000_000_000;

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let token = token(arguments.token_file.as_deref())?;
    let program = std::env::current_exe().map_err(Error::io("find", "this program".as_ref()))?;
    let level = if output.quiet {
        Level::WARN
    } else {
        Level::INFO
    };
    // Initialisation fails only if it is repeated in one process.
    let _ = tracing_subscriber::fmt()
        .json()
        .with_max_level(level)
        .with_writer(std::io::stderr)
        .try_init();
    let free = memory::available().unwrap_or(MEMORY);
    let settings = Settings {
        listen: arguments.listen,
        store: arguments.store.clone(),
        token,
        hosts: arguments.host,
        program: program.into(),
        jobs_at_once: arguments.jobs.into(),
        longest_queue: arguments.queue,
        largest_file: arguments.file_mb * 1_000_000,
        limits: JobLimits {
            memory: (arguments.job_memory_mb)
                .map_or(free / u64::from(arguments.jobs), |mb| mb * 1_000_000),
            seconds: arguments.job_seconds,
            file: arguments.job_file_mb * 1_000_000,
            threads: rayon::current_num_threads() as u16,
        },
    };
    // Files of the store and of its jobs are accessible only to this user.
    rustix::process::umask(Mode::RWXG | Mode::RWXO);
    let service = Service::open(settings)?;
    let pages = service::router(service.clone());
    let listening = |address: SocketAddr| {
        let store = crate::error::printable::path(&arguments.store);
        let text = format!("listening on http://{address}, jobs in {store}");
        let value = serde_json::json!({ "listening": format!("http://{address}"), "store": arguments.store.to_string_lossy() });
        output.result(&value, &text)
    };
    service::serve(service, pages, listening, &STOP)
}

/// Reads the token from the file or from the environment.
fn token(file: Option<&Path>) -> Result<Option<String>> {
    let text = match file {
        Some(file) => {
            let expected = "a token, as text of at most 65536 bytes";
            Some(input_file::read_text(file, 1 << 16, expected)?)
        }
        None => std::env::var(service::TOKEN_VARIABLE).ok(),
    };
    Ok(text.map(|text| text.trim().to_owned()))
}
