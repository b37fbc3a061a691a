//! Lines that are written by a thread of their own: whoever has one to write never waits and never fails.
//!
//! What there is no room for, or what cannot be written (a full disk, a closed pipe), is left out and counted; once writing
//! works again, a line says how many were left out.

use std::{
    io::Write,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

/// Lines that wait for the thread.
const ROOM: usize = 4096;
/// How long after a line was left out that is said, when no other line comes.
const NOTE_AFTER: Duration = Duration::from_secs(1);

/// The way to the thread that writes. Clones lead to the same thread, which ends with the last of them.
#[derive(Clone, Debug)]
pub(crate) struct Lines {
    sender: SyncSender<Item>,
    left_out: Arc<AtomicU64>,
}

enum Item {
    Line(Vec<u8>),
    /// Says that every line before it was written.
    Flush(SyncSender<()>),
}

impl Lines {
    /// Starts a thread that writes to `sink`. `note` makes the line that says how many were left out.
    ///
    /// # Errors
    /// When the system has no thread.
    pub(crate) fn start(
        name: &str,
        sink: impl Write + Send + 'static,
        note: impl Fn(u64) -> Vec<u8> + Send + 'static,
    ) -> std::io::Result<Self> {
        let (sender, receiver) = sync_channel(ROOM);
        let left_out = Arc::new(AtomicU64::new(0));
        let writer = Writer {
            sink,
            note,
            left_out: Arc::clone(&left_out),
        };
        thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || writer.run(&receiver))?;
        Ok(Self { sender, left_out })
    }

    /// Has a line written, its end of line included; false when it was left out.
    pub(crate) fn push(&self, line: Vec<u8>) -> bool {
        let pushed = self.sender.try_send(Item::Line(line)).is_ok();
        if !pushed {
            self.leave_out();
        }
        pushed
    }

    /// Counts a line that its maker left out.
    pub(crate) fn leave_out(&self) {
        self.left_out.fetch_add(1, Ordering::Relaxed);
    }

    /// Waits until what was pushed is written, but no longer than `patience`.
    pub(crate) fn flush(&self, patience: Duration) {
        let (done, written) = sync_channel(1);
        if self.sender.try_send(Item::Flush(done)).is_ok() {
            let _ = written.recv_timeout(patience);
        }
    }
}

struct Writer<W, N> {
    sink: W,
    note: N,
    left_out: Arc<AtomicU64>,
}

impl<W: Write, N: Fn(u64) -> Vec<u8>> Writer<W, N> {
    fn run(mut self, items: &Receiver<Item>) {
        loop {
            match items.recv_timeout(NOTE_AFTER) {
                Ok(Item::Line(line)) => {
                    if !self.write(&line) {
                        self.left_out.fetch_add(1, Ordering::Relaxed);
                    }
                }
                Ok(Item::Flush(done)) => {
                    let _ = self.sink.flush();
                    let _ = done.try_send(());
                }
                Err(RecvTimeoutError::Timeout) => self.say_what_was_left_out(),
                Err(RecvTimeoutError::Disconnected) => return self.say_what_was_left_out(),
            }
        }
    }

    fn write(&mut self, line: &[u8]) -> bool {
        self.sink.write_all(line).is_ok()
    }

    fn say_what_was_left_out(&mut self) {
        let count = self.left_out.swap(0, Ordering::Relaxed);
        if count > 0 && !self.write(&(self.note)(count)) {
            self.left_out.fetch_add(count, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io,
        sync::{Mutex, atomic::AtomicBool},
    };

    use super::*;

    /// A sink that can be made to fail, as a full disk does.
    #[derive(Clone, Default)]
    struct Disk {
        written: Arc<Mutex<Vec<u8>>>,
        full: Arc<AtomicBool>,
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.full.load(Ordering::SeqCst) {
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.written.lock().expect("lock").extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_full_disk_loses_lines_and_says_so_once_there_is_room() {
        let disk = Disk::default();
        let note = |count| format!("{count} left out\n").into_bytes();
        let lines = Lines::start("test", disk.clone(), note).expect("a thread");
        let flush = || lines.flush(Duration::from_secs(60));
        lines.push(b"one\n".to_vec());
        flush();
        disk.full.store(true, Ordering::SeqCst);
        lines.push(b"two\n".to_vec());
        lines.push(b"three\n".to_vec());
        flush();
        disk.full.store(false, Ordering::SeqCst);
        lines.push(b"four\n".to_vec());
        flush();
        let text = || String::from_utf8(disk.written.lock().expect("lock").clone()).expect("text");
        let start = std::time::Instant::now();
        while !text().contains("left out") {
            assert!(start.elapsed() < Duration::from_secs(60), "{}", text());
            thread::sleep(Duration::from_millis(20));
        }
        assert_eq!(text(), "one\nfour\n2 left out\n");
    }

    #[test]
    fn a_sink_that_blocks_holds_up_nobody() {
        struct Blocked(Receiver<()>);
        impl Write for Blocked {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                let _ = self.0.recv();
                Ok(bytes.len())
            }

            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let (unblock, blocked) = std::sync::mpsc::channel();
        let lines = Lines::start("test", Blocked(blocked), |_| Vec::new()).expect("a thread");
        let pushed = (0..2 * ROOM)
            .filter(|_| lines.push(b"x\n".to_vec()))
            .count();
        assert!((ROOM..ROOM + 2).contains(&pushed), "{pushed}");
        drop(unblock);
    }
}
