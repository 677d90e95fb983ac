//! `omniloc man`: the manual pages.

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::Context;
use clap_mangen::Man;

use super::{DONE, print};

/// Print the manual page, or write one page a command
///
/// To read it: omniloc man | man -l -
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder for omniloc.1 and a page for every command, made if it is not there; pages in it are replaced
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// `command` is the whole program's.
pub fn run(args: &Args, command: clap::Command) -> anyhow::Result<ExitCode> {
    // A page for `help` would say nothing.
    let mut command = command.disable_help_subcommand(true);
    // Gives the commands their full names, such as `omniloc-train`.
    command.build();
    let source = format!("{} {}", command.get_name(), env!("CARGO_PKG_VERSION"));
    match &args.out {
        None => {
            let mut page = Vec::new();
            Man::new(command).source(source).render(&mut page)?;
            print(&String::from_utf8(page)?)?;
        }
        Some(folder) => {
            fs::create_dir_all(folder).with_context(|| format!("making the folder {}", folder.display()))?;
            let pages = write_pages(&command, &source, folder)
                .with_context(|| format!("writing manual pages to {}", folder.display()))?;
            print(&pages.iter().map(|page| format!("{}\n", page.display())).collect::<String>())?;
        }
    }
    Ok(DONE.into())
}

/// Writes the page of `command` and those of the commands below it; returns their paths.
fn write_pages(command: &clap::Command, source: &str, folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut pages = vec![Man::new(command.clone()).source(source).generate_to(folder)?];
    for below in command.get_subcommands().filter(|below| !below.is_hide_set()) {
        pages.extend(write_pages(below, source, folder)?);
    }
    Ok(pages)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_gets_a_page() {
        let folder = tempfile::TempDir::new().expect("a temporary folder");
        let out = folder.path().join("man1");
        let command = clap::Command::new("omniloc")
            .about("Tells where it is")
            .subcommand(clap::Command::new("train").about("Make a map"))
            .subcommand(clap::Command::new("secret").hide(true));
        run(&Args { out: Some(out.clone()) }, command).expect("writes");
        let read = |name: &str| fs::read_to_string(out.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(read("omniloc.1").contains("omniloc\\-train(1)"));
        assert!(read("omniloc-train.1").contains("Make a map"));
        assert_eq!(fs::read_dir(&out).expect("readable").count(), 2);
    }
}
