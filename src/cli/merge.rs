use super::Output;
use super::scan::Whole;
use crate::error::Result;
use crate::run;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scan: Whole,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    arguments
        .scan
        .whole(output, false, |scene, options, out, control| {
            run::merge(scene, options, out, control)
        })
}
