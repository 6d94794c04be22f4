use super::{Output, STOP, SceneArguments, show};
use crate::error::{Error, Result};
use crate::run::Control;
use crate::view;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::sync::Arc;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Address and port to answer on, of this machine alone; port 0 is one that is free
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:0")]
    listen: SocketAddr,
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
    let failed = Error::io("listen on", Path::new(&arguments.listen.to_string()));
    let listener = TcpListener::bind(arguments.listen).map_err(failed)?;
    let scene = pool.install(|| arguments.scene.load(output))?;
    let building = output.share("of the hierarchy built");
    let control = Control {
        progress: &|_| {},
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let session = Arc::new(view::Session::new(&scene, pool, &control)?);
    let address = listener
        .local_addr()
        .map_err(Error::io("listen on", Path::new("the address")))?;
    let address = format!("http://{address}/");
    let text = format!("{address}\nopen it in a browser on this machine; Ctrl-C ends");
    output.result(&Started { address }, &text)?;
    view::serve(session, listener, &STOP)
}
