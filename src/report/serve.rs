//! A page for one person on this machine: just enough of HTTP/1.1 (RFC 9112), and nothing that anybody could misuse.
//!
//! It listens on 127.0.0.1 alone and answers GET alone. Addresses begin with a random token, so that no other user and no
//! other page can guess one; the `Host` must be this machine, so that no foreign name can point here. A request has
//! [`PATIENCE`] and [`HEADER_BYTES`]; [`MOST_AT_ONCE`] are answered at a time, and more are turned away. What may be
//! read is decided by whoever answers, by comparing whole addresses: no path is ever made from one.

use crate::{Error, ErrorKind, Result};
use std::io::{ErrorKind as Io, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// A request may take so long, and an answer so long without any of it going.
const PATIENCE: Duration = Duration::from_secs(5);
/// An answer may take so long.
const LONGEST: Duration = Duration::from_secs(60);
/// A request may be so long.
const HEADER_BYTES: usize = 8192;
/// So many connections at a time; a browser opens six.
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
        let busy = AtomicUsize::new(0);
        std::thread::scope(|threads| {
            while !stop() {
                let Ok((stream, _)) = self.listener.accept() else {
                    std::thread::sleep(LOOK / 5);
                    continue;
                };
                if busy.load(Ordering::SeqCst) >= MOST_AT_ONCE {
                    continue; // dropped, and so closed
                }
                busy.fetch_add(1, Ordering::SeqCst);
                let busy = &busy;
                threads.spawn(move || {
                    // a client that goes away needs no answer
                    let _ = self.answer(stream, stop, answer);
                    busy.fetch_sub(1, Ordering::SeqCst);
                });
            }
        });
    }

    fn answer(
        &self,
        mut stream: TcpStream,
        stop: &dyn Fn() -> bool,
        answer: &dyn Fn(&str) -> Option<Answer>,
    ) -> std::io::Result<()> {
        stream.set_nonblocking(false)?;
        stream.set_read_timeout(Some(LOOK))?;
        stream.set_write_timeout(Some(LOOK))?;
        let (status, found) = match read_request(&mut stream, stop)? {
            None => ("400 Bad Request", None),
            Some(request) => match self.target(&request) {
                Err(status) => (status, None),
                Ok(rest) => match answer(rest) {
                    None => ("404 Not Found", None),
                    found => ("200 OK", found),
                },
            },
        };
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
        send(&mut stream, head.as_bytes(), stop)?;
        send(&mut stream, &body, stop)
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

/// The head of a request; `None` if it is too long, too slow, or no text.
fn read_request(stream: &mut TcpStream, stop: &dyn Fn() -> bool) -> std::io::Result<Option<String>> {
    let begin = Instant::now();
    let (mut head, mut part) = (Vec::new(), [0; 1024]);
    while begin.elapsed() < PATIENCE && !stop() {
        match stream.read(&mut part) {
            Ok(0) => return Ok(None),
            Ok(n) => head.extend_from_slice(&part[..n]),
            Err(e) if is_slow(&e) => continue,
            Err(e) => return Err(e),
        }
        if let Some(end) = head.windows(4).position(|w| w == b"\r\n\r\n") {
            head.truncate(end);
            return Ok((end <= HEADER_BYTES).then(|| String::from_utf8(head).ok()).flatten());
        }
        if head.len() > HEADER_BYTES {
            return Ok(None);
        }
    }
    Ok(None)
}

fn is_slow(e: &std::io::Error) -> bool {
    matches!(e.kind(), Io::WouldBlock | Io::TimedOut | Io::Interrupted)
}

/// Sends all of it, unless nothing of it goes for some time, all of it takes too long, or a stop is asked for.
fn send(stream: &mut TcpStream, mut bytes: &[u8], stop: &dyn Fn() -> bool) -> std::io::Result<()> {
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
        let begin = Instant::now();
        with_server(|server, ask| {
            let silent: Vec<TcpStream> = (0..MOST_AT_ONCE - 2)
                .map(|_| TcpStream::connect(("127.0.0.1", server.port)).unwrap())
                .collect();
            let request =
                format!("GET /{}/ HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", server.token, server.port);
            assert!(ask(request.as_bytes()).starts_with("HTTP/1.1 200 "));
            drop(silent);
        });
        assert!(begin.elapsed() < PATIENCE, "{:?}", begin.elapsed());
    }
}
