use super::{Output, STOP, SceneArguments, show};
use crate::error::{Error, Result};
use crate::run::Control;
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
    /// Address and port to answer on, of this machine alone; port 0 is one that is free
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:0")]
    listen: SocketAddr,
    /// Socket file on which the service asks in place of a browser
    #[arg(long, value_name = "FILE", hide = true)]
    socket: Option<PathBuf>,
}

/// What a program that started the view needs to know.
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
    // Before the hierarchy is built, so that a port that is taken is said at once.
    let address = arguments.listen.to_string();
    let failed = || Error::io("listen on", Path::new(&address));
    let browsers = match arguments.socket {
        Some(_) => None,
        None => Some(TcpListener::bind(arguments.listen).map_err(failed())?),
    };
    let scene = pool.install(|| arguments.scene.load(output))?;
    let building = output.share("prepared");
    let control = Control {
        progress: &|_| {},
        building: Some(&|share| show(&building, share)),
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
            // Of a view that was killed.
            files::remove(&socket)?;
            let listener = UnixListener::bind(&socket).map_err(Error::io("listen on", &socket))?;
            (Listener::Service(listener), socket.display().to_string())
        }
    };
    let text = format!("{address}\nopen it in a browser on this machine; Ctrl-C ends");
    output.result(&Started { address }, &text)?;
    view::serve(session, listener, &STOP)
}
