//! A disk that loses power, and one that fails: a model of what a file system keeps.
//!
//! Writes go to a page cache. What was synced stays. Of the rest, each 4 KiB block reaches the disk, does not, or does in
//! part (512-byte sectors), in any order; the file's size may or may not have grown, and what never came is zeros. A
//! creation, renaming or removal lasts when the folder was synced; otherwise it may be undone.

#![allow(dead_code, reason = "each test program uses a part")]

use std::{
    collections::BTreeMap,
    io::{self, Cursor, Write},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use omniloc::recording::recorder::{FileFacts, ReadSeek, SegmentFile, Space, Storage};
use rand::{Rng, rngs::StdRng};

const BLOCK_BYTES: usize = 4096;
const SECTOR_BYTES: usize = 512;

#[derive(Debug, Clone, Default)]
struct Inode {
    /// What programs see.
    cached: Vec<u8>,
    /// What was synced last.
    synced: Vec<u8>,
}

#[derive(Debug, Clone)]
enum FolderChange {
    Create(String, usize),
    Rename(String, String),
    Remove(String),
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The power is cut: this operation is the last to do anything, and the computer with it.
    PowerCut,
    Error(io::ErrorKind),
    /// Half of a write succeeds, then it fails.
    ShortWrite,
}

/// From one operation up to another, not included.
#[derive(Debug, Clone, Copy)]
pub struct FaultPlan {
    pub fault: Fault,
    pub from: u64,
    pub to: u64,
}

#[derive(Debug, Clone, Default)]
struct State {
    inodes: Vec<Inode>,
    folder: BTreeMap<String, usize>,
    synced_folder: BTreeMap<String, usize>,
    unsynced_changes: Vec<FolderChange>,
    operations: u64,
    plan: Option<FaultPlan>,
    /// Of the whole disk; 0: more than enough.
    capacity_bytes: u64,
}

#[derive(Debug, Clone, Default)]
pub struct Disk {
    state: Arc<Mutex<State>>,
}

impl Disk {
    pub fn new() -> Self {
        Self::default()
    }

    /// A disk that gets full.
    pub fn with_capacity(capacity_bytes: u64) -> Self {
        let disk = Self::default();
        disk.lock().capacity_bytes = capacity_bytes;
        disk
    }

    pub fn set_plan(&self, plan: Option<FaultPlan>) {
        self.lock().plan = plan;
    }

    /// Operations so far.
    pub fn operations(&self) -> u64 {
        self.lock().operations
    }

    /// Whether an operation of the plan was asked for.
    pub fn plan_has_begun(&self) -> bool {
        let state = self.lock();
        state.plan.is_some_and(|plan| state.operations > plan.from)
    }

    pub fn names(&self) -> Vec<String> {
        self.lock().folder.keys().cloned().collect()
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        let state = self.lock();
        state.inodes[state.folder[name]].cached.clone()
    }

    /// What is on the disk when the power comes back.
    pub fn after_power_cut(&self, random: &mut StdRng) -> Self {
        let state = self.lock();
        let mut folder = state.synced_folder.clone();
        let in_order = random.random_bool(0.7);
        let kept_changes = random.random_range(0..=state.unsynced_changes.len());
        for (index, change) in state.unsynced_changes.iter().enumerate() {
            if if in_order { index < kept_changes } else { random.random_bool(0.5) } {
                apply(&mut folder, change);
            }
        }
        let inodes = state.inodes.iter().map(|inode| {
            let survived = survivors(inode, random);
            Inode { cached: survived.clone(), synced: survived }
        });
        let inodes = inodes.collect();
        let capacity_bytes = state.capacity_bytes;
        let state = State { inodes, synced_folder: folder.clone(), folder, capacity_bytes, ..State::default() };
        Self { state: Arc::new(Mutex::new(state)) }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn apply(folder: &mut BTreeMap<String, usize>, change: &FolderChange) {
    match change {
        FolderChange::Create(name, inode) => drop(folder.insert(name.clone(), *inode)),
        FolderChange::Remove(name) => drop(folder.remove(name)),
        FolderChange::Rename(from, to) => {
            if let Some(inode) = folder.remove(from) {
                folder.insert(to.clone(), inode);
            }
        }
    }
}

/// A file's content after a power cut.
fn survivors(inode: &Inode, random: &mut StdRng) -> Vec<u8> {
    let Inode { cached, synced } = inode;
    if cached.len() < synced.len() {
        // Cut off, not synced.
        return if random.random_bool(0.5) { cached.clone() } else { synced.clone() };
    }
    let size = match random.random_range(0..4) {
        0 => synced.len(),
        1 => cached.len(),
        2 => random.random_range(synced.len()..=cached.len()),
        _ => (random.random_range(synced.len()..=cached.len()) / BLOCK_BYTES * BLOCK_BYTES).max(synced.len()),
    };
    let mut survived = synced.clone();
    survived.resize(size, 0);
    let lost_share = [0.0, 0.1, 0.5, 0.9][random.random_range(0..4)];
    for block in (synced.len() / BLOCK_BYTES * BLOCK_BYTES..size).step_by(BLOCK_BYTES) {
        let is_torn = random.random_bool(0.2);
        let is_lost = random.random_bool(lost_share);
        for start in (block..size.min(block + BLOCK_BYTES)).step_by(SECTOR_BYTES) {
            let comes_through = if is_torn { random.random_bool(0.5) } else { !is_lost };
            if comes_through {
                let sector = start..size.min(start + SECTOR_BYTES);
                survived[sector.clone()].copy_from_slice(&cached[sector]);
            }
        }
    }
    survived
}

impl State {
    /// Counts an operation; `Some` if it fails.
    fn next(&mut self) -> Option<Fault> {
        let number = self.operations;
        self.operations += 1;
        self.plan.filter(|plan| (plan.from..plan.to).contains(&number)).map(|plan| plan.fault)
    }

    fn space(&self) -> Space {
        if self.capacity_bytes == 0 {
            return Space { free_bytes: 1 << 40, total_bytes: 1 << 41 };
        }
        let used: u64 = self.folder.values().map(|&inode| self.inodes[inode].cached.len() as u64).sum();
        Space { free_bytes: self.capacity_bytes.saturating_sub(used), total_bytes: self.capacity_bytes }
    }

    fn change(&mut self, change: FolderChange) {
        apply(&mut self.folder, &change);
        self.unsynced_changes.push(change);
    }
}

fn error(fault: Fault) -> io::Error {
    match fault {
        Fault::PowerCut => io::Error::other("the power is cut"),
        Fault::Error(kind) => kind.into(),
        Fault::ShortWrite => io::Error::other("an I/O error"),
    }
}

fn check(fault: Option<Fault>) -> io::Result<()> {
    fault.map_or(Ok(()), |fault| Err(error(fault)))
}

struct OpenFile {
    disk: Disk,
    inode: usize,
}

impl Write for OpenFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.disk.lock();
        let first = state.plan.map(|plan| plan.from);
        let is_first = first == Some(state.operations);
        let mut fault = state.next();
        if fault.is_none() && state.space().free_bytes < bytes.len() as u64 {
            fault = Some(Fault::Error(io::ErrorKind::StorageFull));
        }
        let cached = &mut state.inodes[self.inode].cached;
        match fault {
            Some(Fault::ShortWrite) if is_first => {
                cached.extend_from_slice(&bytes[..bytes.len() / 2]);
                // The caller comes again with the other half.
                let plan = state.plan.as_mut().expect("there is a fault");
                plan.to = plan.to.max(plan.from + 2);
                if bytes.len() < 2 { Err(error(Fault::ShortWrite)) } else { Ok(bytes.len() / 2) }
            }
            Some(Fault::PowerCut) if is_first => {
                cached.extend_from_slice(&bytes[..bytes.len() / 2]);
                Err(error(Fault::PowerCut))
            }
            Some(fault) => Err(error(fault)),
            None => {
                cached.extend_from_slice(bytes);
                Ok(bytes.len())
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl SegmentFile for OpenFile {
    fn sync_data(&mut self) -> io::Result<()> {
        let mut state = self.disk.lock();
        check(state.next())?;
        let inode = &mut state.inodes[self.inode];
        inode.synced.clone_from(&inode.cached);
        Ok(())
    }

    fn set_len(&mut self, bytes: u64) -> io::Result<()> {
        let mut state = self.disk.lock();
        check(state.next())?;
        state.inodes[self.inode].cached.truncate(bytes as usize);
        Ok(())
    }
}

impl Storage for Disk {
    fn create(&self, name: &str) -> io::Result<Box<dyn SegmentFile>> {
        let mut state = self.lock();
        check(state.next())?;
        if state.folder.contains_key(name) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        state.inodes.push(Inode::default());
        let inode = state.inodes.len() - 1;
        state.change(FolderChange::Create(name.into(), inode));
        Ok(Box::new(OpenFile { disk: self.clone(), inode }))
    }

    /// Reading is no operation that fails.
    fn open(&self, name: &str) -> io::Result<Box<dyn ReadSeek>> {
        let state = self.lock();
        let inode = *state.folder.get(name).ok_or(io::ErrorKind::NotFound)?;
        Ok(Box::new(Cursor::new(state.inodes[inode].cached.clone())))
    }

    fn rename(&self, from: &str, to: &str) -> io::Result<()> {
        let mut state = self.lock();
        check(state.next())?;
        if !state.folder.contains_key(from) {
            return Err(io::ErrorKind::NotFound.into());
        }
        state.change(FolderChange::Rename(from.into(), to.into()));
        Ok(())
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let mut state = self.lock();
        if !state.folder.contains_key(name) {
            return Err(io::ErrorKind::NotFound.into());
        }
        check(state.next())?;
        state.change(FolderChange::Remove(name.into()));
        Ok(())
    }

    fn list(&self) -> io::Result<Vec<FileFacts>> {
        let state = self.lock();
        let facts = |(name, &inode): (&String, &usize)| FileFacts {
            name: name.clone(),
            bytes: state.inodes[inode].cached.len() as u64,
        };
        Ok(state.folder.iter().map(facts).collect())
    }

    fn space(&self) -> io::Result<Space> {
        Ok(self.lock().space())
    }

    fn sync_folder(&self) -> io::Result<()> {
        let mut state = self.lock();
        check(state.next())?;
        state.unsynced_changes.clear();
        state.synced_folder = state.folder.clone();
        Ok(())
    }
}
