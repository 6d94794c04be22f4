use super::Output;
use super::scan::ScanArguments;
use crate::error::Result;
use crate::run;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scan: ScanArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    arguments
        .scan
        .run_full_scan(output, false, |scene, options, out, control| {
            run::merge(scene, options, out, control)
        })
}
