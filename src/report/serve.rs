//! A page for one person on this machine: just enough of HTTP/1.1 (RFC 9112), and nothing that anybody could misuse.
//!
//! It listens on 127.0.0.1 alone and answers GET alone. Addresses begin with a random token, so that no other user and no
//! other page can guess one; the `Host` must be this machine, so that no foreign name can point here. A request has
//! [`REQUEST_TIME`] and [`HEADER_BYTES`], and [`MOST_WAITING`] are listened to side by side: the oldest makes room for the
//! next. Only those with the token take one of the [`MOST_AT_ONCE`] threads that answer; more are turned away. What may
//! be read is decided by whoever answers, by comparing whole addresses: no path is ever made from one.

use crate::{Error, ErrorKind, Result};
use std::collections::VecDeque;
use std::io::{ErrorKind as Io, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// A request may take so long.
const REQUEST_TIME: Duration = Duration::from_secs(2);
/// An answer may take so long without any of it going.
const PATIENCE: Duration = Duration::from_secs(5);
/// An answer may take so long.
const LONGEST: Duration = Duration::from_secs(60);
/// A request may be so long.
const HEADER_BYTES: usize = 8192;
/// So many connections may have sent no whole request yet.
const MOST_WAITING: usize = 64;
/// So many answers at a time; a browser opens six connections.
const MOST_AT_ONCE: usize = 16;
/// How often a stop is looked for.
const LOOK: Duration = Duration::from_millis(100);

/// What is sent for an address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Answer {
    /// As in `Content-Type`.
    pub kind: &'static str,
    /// The bytes.
    pub body: Vec<u8>,
}

/// A listener and the token that addresses begin with.
pub struct Server {
    listener: TcpListener,
    port: u16,
    token: String,
}

impl Server {
    /// Returns a server on a free port.
    ///
    /// # Errors
    ///
    /// The system gives no port or no random numbers.
    pub fn open() -> Result<Server> {
        let cannot = |what: &str| format!("a page cannot be served: {what}");
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0));
        let listener = listener.and_then(|l| l.set_nonblocking(true).map(|()| l));
        let listener = listener.map_err(|e| Error::new(ErrorKind::NotNow, cannot(&e.to_string())))?;
        let port = listener.local_addr().map_err(|e| Error::cannot(cannot(&e.to_string()), ""))?.port();
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|e| Error::cannot(cannot(&e.to_string()), ""))?;
        Ok(Server { listener, port, token: bytes.iter().map(|b| format!("{b:02x}")).collect() })
    }

    /// The address of the first page.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.token)
    }

    /// Answers until `stop`: `answer` gets what follows the token and its slash, as it was sent, without a query.
    pub fn run(&self, stop: &(dyn Fn() -> bool + Sync), answer: &(dyn Fn(&str) -> Option<Answer> + Sync)) {
        let (busy, mut waiting) = (AtomicUsize::new(0), VecDeque::new());
        std::thread::scope(|threads| {
            while !stop() {
                match self.listener.accept() {
                    Ok((stream, _)) => {
                        waiting.push_back(Request { stream, begin: Instant::now(), head: Vec::new() });
                        if waiting.len() > MOST_WAITING {
                            waiting.pop_front(); // dropped, and so closed
                        }
                    }
                    Err(_) => std::thread::sleep(LOOK / 5),
                }
                for mut request in std::mem::take(&mut waiting) {
                    let Some(head) = request.read() else {
                        waiting.push_back(request);
                        continue;
                    };
                    let (mut stream, busy) = (request.stream, &busy);
                    match self.target(&head).map(str::to_owned) {
                        // it fits into the system's buffer, and a client that goes away needs no answer
                        Err(status) => drop(stream.write(&reply(status, None))),
                        Ok(_) if busy.load(Ordering::SeqCst) >= MOST_AT_ONCE => {}
                        Ok(rest) => {
                            busy.fetch_add(1, Ordering::SeqCst);
                            threads.spawn(move || {
                                let found = answer(&rest);
                                let status = if found.is_some() { "200 OK" } else { "404 Not Found" };
                                let _ = send(&mut stream, &reply(status, found), stop);
                                busy.fetch_sub(1, Ordering::SeqCst);
                            });
                        }
                    }
                }
            }
        });
    }

    /// What a request asks for after the token, or the status that refuses it.
    fn target<'r>(&self, request: &'r str) -> std::result::Result<&'r str, &'static str> {
        let mut lines = request.split("\r\n");
        let first: Vec<&str> = lines.next().unwrap_or_default().split(' ').collect();
        let [method, target, version] = first[..] else { return Err("400 Bad Request") };
        if !version.starts_with("HTTP/1.") {
            return Err("505 HTTP Version Not Supported");
        }
        if method != "GET" {
            return Err("405 Method Not Allowed");
        }
        let mut hosts =
            lines.filter_map(|l| l.split_once(':')).filter(|(k, _)| k.eq_ignore_ascii_case("host"));
        let ours = ["127.0.0.1", "localhost"].map(|name| format!("{name}:{}", self.port));
        match (hosts.next(), hosts.next()) {
            (Some((_, host)), None) if ours.iter().any(|our| host.trim() == our) => {}
            _ => return Err("403 Forbidden"),
        }
        let path = target.split(['?', '#']).next().unwrap_or_default();
        let inside = path.strip_prefix('/').and_then(|p| p.strip_prefix(&self.token)?.strip_prefix('/'));
        inside.ok_or("404 Not Found")
    }
}

/// A connection whose request is not whole yet.
struct Request {
    stream: TcpStream,
    begin: Instant,
    head: Vec<u8>,
}

impl Request {
    /// Reads what has come, without waiting. Returns the head once it is whole; an empty one if it is too long, too slow, or
    /// no text.
    fn read(&mut self) -> Option<String> {
        let mut part = [0; 1024];
        let is_open = self.stream.set_nonblocking(true).is_ok();
        while is_open && self.begin.elapsed() < REQUEST_TIME {
            match self.stream.read(&mut part) {
                Ok(0) => break,
                Ok(n) => self.head.extend_from_slice(&part[..n]),
                Err(e) if is_slow(&e) => return None,
                Err(_) => break,
            }
            let end = self.head.windows(4).position(|w| w == b"\r\n\r\n");
            if end.unwrap_or(self.head.len()) > HEADER_BYTES {
                break;
            }
            if let Some(end) = end {
                self.head.truncate(end);
                return Some(String::from_utf8(std::mem::take(&mut self.head)).unwrap_or_default());
            }
        }
        Some(String::new())
    }
}

/// A whole answer, or the words of its status.
fn reply(status: &str, found: Option<Answer>) -> Vec<u8> {
    let Answer { kind, body } = found.unwrap_or_else(|| Answer {
        kind: "text/plain; charset=utf-8",
        body: format!("{status}\n").into_bytes(),
    });
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\
         Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
         Cross-Origin-Resource-Policy: same-origin\r\nContent-Security-Policy: default-src 'none'; img-src 'self' \
         data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'; \
         form-action 'none'; frame-ancestors 'none'\r\n\r\n",
        body.len()
    );
    [head.into_bytes(), body].concat()
}

fn is_slow(e: &std::io::Error) -> bool {
    matches!(e.kind(), Io::WouldBlock | Io::TimedOut | Io::Interrupted)
}

/// Sends all of it, unless nothing of it goes for some time, all of it takes too long, or a stop is asked for.
fn send(stream: &mut TcpStream, mut bytes: &[u8], stop: &dyn Fn() -> bool) -> std::io::Result<()> {
    stream.set_nonblocking(false)?;
    stream.set_write_timeout(Some(LOOK))?;
    let begin = Instant::now();
    let mut moved = begin;
    while !bytes.is_empty() {
        if stop() || moved.elapsed() > PATIENCE || begin.elapsed() > LONGEST {
            return Err(Io::TimedOut.into());
        }
        match stream.write(bytes) {
            Ok(0) => return Err(Io::WriteZero.into()),
            Ok(n) => (bytes, moved) = (&bytes[n..], Instant::now()),
            Err(e) if is_slow(&e) => {}
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;

    /// What a server answers to raw bytes, up to its first `most` bytes.
    fn with_server(test: impl FnOnce(&Server, &dyn Fn(&[u8]) -> String)) {
        let (server, over) = (Server::open().unwrap(), AtomicBool::new(false));
        let stop = || over.load(Ordering::SeqCst);
        let answer = |path: &str| {
            let known = ["", "a%20b.png"].contains(&path);
            known.then(|| Answer { kind: "text/plain", body: format!("found {path}").into_bytes() })
        };
        let ask = |bytes: &[u8]| {
            let mut stream = TcpStream::connect(("127.0.0.1", server.port)).unwrap();
            let _ = stream.write_all(bytes);
            let mut text = Vec::new();
            let _ = stream.read_to_end(&mut text);
            String::from_utf8_lossy(&text).into_owned()
        };
        std::thread::scope(|threads| {
            threads.spawn(|| server.run(&stop, &answer));
            let ended = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| test(&server, &ask)));
            over.store(true, Ordering::SeqCst);
            if let Err(panic) = ended {
                std::panic::resume_unwind(panic);
            }
        });
    }

    #[test]
    fn only_whole_addresses_with_the_token_are_answered() {
        with_server(|server, ask| {
            let get = |path: &str| {
                ask(format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", server.port).as_bytes())
            };
            let token = &server.token;
            assert_eq!(token.len(), 32);
            assert!(get(&format!("/{token}/")).ends_with("\r\n\r\nfound "));
            assert!(get(&format!("/{token}/a%20b.png?t=1")).ends_with("found a%20b.png"));
            for path in [
                "/".into(),
                format!("/{token}"),
                format!("/{}/", &token[1..]),
                format!("/{token}/../etc/passwd"),
                format!("/{token}/%2e%2e/%2e%2e/etc/passwd"),
                format!("/{token}//etc/passwd"),
                format!("//{token}/"),
                format!("http://127.0.0.1/{token}/"),
            ] {
                assert!(get(&path).starts_with("HTTP/1.1 404 "), "{path}");
            }
        });
    }

    #[test]
    fn other_methods_foreign_hosts_and_senseless_requests_are_refused() {
        with_server(|server, ask| {
            let (port, token) = (server.port, &server.token);
            let own = format!("Host: localhost:{port}\r\n\r\n");
            for (request, status) in [
                (format!("POST /{token}/ HTTP/1.1\r\n{own}"), 405),
                (format!("HEAD /{token}/ HTTP/1.1\r\n{own}"), 405),
                (format!("GET /{token}/ HTTP/1.1\r\nHost: evil.example:{port}\r\n\r\n"), 403),
                (format!("GET /{token}/ HTTP/1.1\r\nHost: localhost:{port}\r\n{own}"), 403),
                (format!("GET /{token}/ HTTP/1.1\r\n\r\n"), 403),
                (format!("GET /{token}/ SPDY/9\r\n{own}"), 505),
                (format!("GET  /{token}/ HTTP/1.1\r\n{own}"), 400),
                ("\r\n\r\n".into(), 400),
                (format!("GET /{} HTTP/1.1\r\n{own}", "a".repeat(20_000)), 400),
                (format!("GET /{token}/ HTTP/1.1\r\n{own}"), 200),
            ] {
                // one that is too long may be cut off before its answer is read
                let answer = ask(request.as_bytes());
                let cut = request.len() > HEADER_BYTES && answer.is_empty();
                assert!(cut || answer.starts_with(&format!("HTTP/1.1 {status} ")), "{request}: {answer}");
            }
            assert!(ask(b"GET /\xff\xfe HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 400 "));
        });
    }

    #[test]
    fn silent_clients_neither_block_others_nor_the_end() {
        let mut silent = Vec::new();
        with_server(|server, ask| {
            let connect = || TcpStream::connect(("127.0.0.1", server.port)).unwrap();
            let request =
                format!("GET /{}/ HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", server.token, server.port);
            let is_answered = || ask(request.as_bytes()).starts_with("HTTP/1.1 200 ");
            silent.extend((0..2 * MOST_WAITING).map(|_| connect()));
            assert!(is_answered());
            let over = AtomicBool::new(false);
            std::thread::scope(|threads| {
                // a stranger who opens others as soon as they are closed
                threads.spawn(|| {
                    while !over.load(Ordering::SeqCst) {
                        drop((0..MOST_AT_ONCE).map(|_| connect()).collect::<Vec<_>>());
                    }
                });
                let answered = (0..40).filter(|_| is_answered()).count();
                over.store(true, Ordering::SeqCst);
                assert_eq!(answered, 40);
            });
            silent.extend((0..MOST_WAITING).map(|_| connect()));
        });
        // the server has ended, and closed what it was still listening to
        for mut stream in silent {
            stream.set_nonblocking(true).unwrap();
            assert!(!stream.read(&mut [0]).is_err_and(|e| is_slow(&e)));
        }
    }

    #[test]
    fn a_request_in_pieces_is_answered_once_it_is_whole() {
        with_server(|server, ask| {
            let request =
                format!("GET /{}/ HTTP/1.1\r\nHost: localhost:{}\r\n\r\n", server.token, server.port);
            let (first, second) = request.split_at(20);
            let mut stream = TcpStream::connect(("127.0.0.1", server.port)).unwrap();
            stream.write_all(first.as_bytes()).unwrap();
            // the server has looked at the first piece by the time it answers another
            assert!(ask(request.as_bytes()).starts_with("HTTP/1.1 200 "));
            stream.write_all(second.as_bytes()).unwrap();
            let mut text = String::new();
            stream.read_to_string(&mut text).unwrap();
            assert!(text.ends_with("\r\n\r\nfound "), "{text}");
        });
    }
}
