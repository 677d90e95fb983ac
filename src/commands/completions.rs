//! `omniloc completions`: what a shell needs to complete our command line.

use std::process::ExitCode;

use clap_complete::Shell;

use super::{DONE, print};

/// Print the completions of a shell
///
/// For bash: omniloc completions bash > ~/.local/share/bash-completion/completions/omniloc
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The shell to write for
    pub shell: Shell,
}

/// `command` is the whole program's.
pub fn run(args: &Args, command: clap::Command) -> anyhow::Result<ExitCode> {
    print(&String::from_utf8(script(args.shell, command))?)?;
    Ok(DONE.into())
}

fn script(shell: Shell, mut command: clap::Command) -> Vec<u8> {
    let mut script = Vec::new();
    let name = command.get_name().to_owned();
    clap_complete::generate(shell, &mut command, name, &mut script);
    script
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::*;

    #[test]
    fn every_shell_completes_the_commands() {
        for &shell in Shell::value_variants() {
            let command = clap::Command::new("omniloc").subcommand(clap::Command::new("evaluate"));
            let script = String::from_utf8(script(shell, command)).unwrap_or_else(|error| panic!("{shell}: {error}"));
            assert!(script.contains("omniloc") && script.contains("evaluate"), "{shell}: {script}");
        }
    }
}
