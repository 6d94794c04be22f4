use super::{Output, STOP, SceneArguments, show};
use crate::error::{Error, Result};
use crate::run::RunControl;
use crate::run::files;
use crate::view::{self, Files, Listener};
use std::net::{SocketAddr, TcpListener};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Loopback address and port to listen on; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:0")]
    listen: SocketAddr,
    /// Unix socket on which the service, instead of a browser, sends requests
    #[arg(long, value_name = "FILE", hide = true)]
    socket: Option<PathBuf>,
}

/// Information for a program that started the view.
#[derive(serde::Serialize)]
struct Started {
    address: String,
}

pub fn run(arguments: Arguments, output: &Output, pool: rayon::ThreadPool) -> Result<()> {
    if !arguments.listen.ip().is_loopback() {
        return Err(Error::Usage(format!(
            "--listen {}: found an address that others reach, expected one of this machine, such as 127.0.0.1:8788: \
             the view asks for no password",
            arguments.listen
        )));
    }
    let names = match arguments.socket {
        Some(_) => Files::AsGiven,
        None => Files::ByFullPath,
    };
    // Bound before the hierarchy is built, so that a port in use is reported immediately.
    let address = arguments.listen.to_string();
    let failed = || Error::io("listen on", Path::new(&address));
    let browsers = match arguments.socket {
        Some(_) => None,
        None => Some(TcpListener::bind(arguments.listen).map_err(failed())?),
    };
    let scene = pool.install(|| arguments.scene.load(output))?;
    let building = output.share("prepared");
    let control = RunControl {
        progress: &|_| {},
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let session = Arc::new(view::Session::new(&scene, names, pool, &control)?);
    let (listener, address) = match (browsers, arguments.socket) {
        (Some(listener), _) => {
            let address = listener.local_addr().map_err(failed())?;
            (Listener::Browsers(listener), format!("http://{address}/"))
        }
        (None, socket) => {
            let socket = socket.unwrap_or_default();
            // The socket may be left over from a view that was killed.
            files::remove(&socket)?;
            let listener = UnixListener::bind(&socket).map_err(Error::io("listen on", &socket))?;
            (Listener::Service(listener), socket.display().to_string())
        }
    };
    let text = format!("{address}\nopen it in a browser on this machine; Ctrl-C ends");
    output.result(&Started { address }, &text)?;
    view::serve(session, listener, &STOP)
}
