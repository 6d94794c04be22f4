//! Commands `completions` and `man`, generated from the definition of the command line.

use super::{Cli, Output};
use crate::error::{Error, Result};
use clap::CommandFactory;
use clap_complete::Shell;

#[derive(clap::Args)]
pub struct Completions {
    /// Shell for which the script is generated
    #[arg(value_enum)]
    shell: Shell,
}

#[derive(clap::Args)]
pub struct Man {
    /// Command described by the page [default: the program]
    command: Option<String>,
}

pub fn completions(arguments: Completions, output: &Output) -> Result<()> {
    let mut bytes = Vec::new();
    let mut command = Cli::command();
    clap_complete::generate(arguments.shell, &mut command, "lasertrace", &mut bytes);
    print(output, "completions", bytes)
}

pub fn man(arguments: Man, output: &Output) -> Result<()> {
    let mut command = Cli::command();
    command.build();
    let page = match &arguments.command {
        None => command,
        Some(name) => (command.find_subcommand(name).cloned())
            .ok_or_else(|| Error::Usage(format!("man {name}: there is no such command")))?,
    };
    let mut bytes = Vec::new();
    let written = clap_mangen::Man::new(page).render(&mut bytes);
    written.expect("writing to memory does not fail");
    print(output, "page", bytes)
}

/// Prints the text, or a JSON object with the text as its only member.
fn print(output: &Output, name: &str, bytes: Vec<u8>) -> Result<()> {
    let text = String::from_utf8(bytes).expect("clap writes UTF-8");
    output.result(&serde_json::json!({ name: text }), &text)
}
