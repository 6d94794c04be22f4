//! Access control: host names, cross-site requests and the token.

use super::connections::{OPEN, Peer};
use super::refusal::HttpError;
use crate::error::{Error, Result};
use axum::Router;
use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderName, Method, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Minimum length of a token in characters; 32 hexadecimal digits are 128 bits.
const SHORTEST_TOKEN: usize = 32;
/// Numbers of wrong tokens per [`MINUTE`], per address and in total, above which further ones are
/// rejected with a delay.
const WRONG_TOKENS: u32 = 10;
const WRONG_TOKENS_OF_ALL: u32 = 100;
/// Delay of the response to a wrong token above these numbers.
const LATE: Duration = Duration::from_secs(1);
const MINUTE: Duration = Duration::from_secs(60);
/// Maximum number of addresses in the table of wrong tokens.
const ADDRESSES: usize = 4096;

/// Conditions that a request must fulfil before it reaches a handler.
pub struct RequestGuard {
    /// SHA-256 of the token. Comparing hashes does not reveal how close a guess is.
    token: Option<[u8; 32]>,
    hosts: Vec<String>,
    wrong: Mutex<HashMap<IpAddr, (u32, Instant)>>,
}

impl RequestGuard {
    /// Creates the guard of a service that listens on `listen`.
    ///
    /// # Errors
    /// `Error::Usage` for a non-loopback address without a token, and for a token that is easy to
    /// guess.
    pub fn new(listen: SocketAddr, token: Option<&str>, hosts: &[String]) -> Result<RequestGuard> {
        if token.is_none() && !listen.ip().is_loopback() {
            return Err(Error::Usage(format!(
                "--listen {listen}: found no token, expected one beyond loopback addresses: --token-file FILE \
                 or the variable {}",
                super::workers::TOKEN_VARIABLE
            )));
        }
        let good = |token: &str| {
            token.len() >= SHORTEST_TOKEN && token.bytes().all(|byte| byte.is_ascii_graphic())
        };
        if token.is_some_and(|token| !good(token)) {
            return Err(Error::Usage(format!(
                "the token: expected at least {SHORTEST_TOKEN} letters, digits and signs without blanks, as \
                 `openssl rand -hex 32` prints"
            )));
        }
        Ok(RequestGuard {
            token: token.map(|token| Sha256::digest(token).into()),
            hosts: hosts.iter().map(|host| host.to_lowercase()).collect(),
            wrong: Mutex::default(),
        })
    }

    /// Adds this guard to `pages`; only requests that it allows reach them.
    pub fn around(self, pages: Router) -> Router {
        pages.layer(from_fn_with_state(Arc::new(self), checked))
    }

    /// Returns true if the service may be called by this host name.
    ///
    /// A site can make its own host name resolve to this machine (DNS rebinding), but its requests
    /// then carry that name. Literal addresses cannot be redirected.
    fn is_host(&self, host: &str) -> bool {
        let Ok(authority) = host.parse::<Authority>() else {
            return false;
        };
        let name = authority.host().to_lowercase();
        let bare = name.trim_start_matches('[').trim_end_matches(']');
        !host.contains('@')
            && (name == "localhost" || bare.parse::<IpAddr>().is_ok() || self.hosts.contains(&name))
    }

    fn check(
        &self,
        method: &Method,
        path: &str,
        headers: &HeaderMap,
        peer: IpAddr,
    ) -> std::result::Result<(), HttpError> {
        let text = |name: HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or("?"));
        let forbidden = |message: String| Err(HttpError::new(StatusCode::FORBIDDEN, message));
        let host = text(header::HOST).unwrap_or("");
        if headers.get_all(header::HOST).iter().count() != 1 || !self.is_host(host) {
            return Err(HttpError::new(
                StatusCode::MISDIRECTED_REQUEST,
                format!(
                    "found the host {host:?}, expected an address, localhost or a name given by --host"
                ),
            ));
        }
        // Only browsers send these headers, and a page cannot change them.
        if let Some(origin) = text(header::ORIGIN)
            && !["http://", "https://"]
                .iter()
                .any(|scheme| origin.strip_prefix(scheme) == Some(host))
        {
            return forbidden(format!("a page of {origin:?} may not ask this service"));
        }
        // A link on another site may open a page. The other site cannot read it.
        let fetch = |name| text(HeaderName::from_static(name));
        let linked = method == Method::GET
            && fetch("sec-fetch-mode") == Some("navigate")
            && fetch("sec-fetch-dest") == Some("document");
        if let Some(site) = fetch("sec-fetch-site")
            && site != "same-origin"
            && site != "none"
            && !linked
        {
            return forbidden(format!(
                "a page of another site ({site}) may not ask this service"
            ));
        }
        match self.token {
            Some(token) if !OPEN.contains(&path) => {
                self.check_token(&token, text(header::AUTHORIZATION), peer)
            }
            _ => Ok(()),
        }
    }

    fn check_token(
        &self,
        token: &[u8; 32],
        given: Option<&str>,
        peer: IpAddr,
    ) -> std::result::Result<(), HttpError> {
        let Some(given) = given.and_then(token_in) else {
            let message = "this service wants a token: the header Authorization: Bearer TOKEN, or in a browser as \
                           the password, with any name";
            return Err(HttpError::new(StatusCode::UNAUTHORIZED, message));
        };
        let given: [u8; 32] = Sha256::digest(given).into();
        // Constant time for every guess.
        let differs = (token.iter().zip(given)).fold(0, |differs, (a, b)| differs | (a ^ b));
        // A client with the correct token is served regardless of wrong tokens from its address.
        if differs == 0 {
            return Ok(());
        }
        let mut wrong = self.wrong.lock().unwrap_or_else(PoisonError::into_inner);
        wrong.retain(|_, (_, since)| since.elapsed() < MINUTE);
        let of_peer = wrong.get(&peer).map_or(0, |(count, _)| *count);
        let of_all: u32 = wrong.values().map(|(count, _)| count).sum();
        if of_peer >= WRONG_TOKENS || of_all >= WRONG_TOKENS_OF_ALL {
            return Err(HttpError::new(
                StatusCode::TOO_MANY_REQUESTS,
                "too many wrong tokens in a minute; this is not the token",
            ));
        }
        if wrong.len() < ADDRESSES || wrong.contains_key(&peer) {
            wrong.entry(peer).or_insert((0, Instant::now())).0 += 1;
        }
        Err(HttpError::new(
            StatusCode::UNAUTHORIZED,
            "this is not the token",
        ))
    }
}

/// Returns the token of an Authorization header: `Bearer TOKEN`, or the password of Basic
/// authentication (RFC 7617).
fn token_in(header: &str) -> Option<String> {
    if let Some(token) = header.strip_prefix("Bearer ") {
        return Some(token.to_owned());
    }
    let pair = BASE64_STANDARD
        .decode(header.strip_prefix("Basic ")?)
        .ok()?;
    let pair = String::from_utf8(pair).ok()?;
    Some(pair.split_once(':')?.1.to_owned())
}

async fn checked(State(guard): State<Arc<RequestGuard>>, request: Request, next: Next) -> Response {
    let peer = request.extensions().get::<Peer>().map(|peer| peer.0.ip());
    // A request that did not arrive through a TCP connection has no address.
    let peer = peer.unwrap_or(IpAddr::from([0, 0, 0, 0]));
    match guard.check(
        request.method(),
        request.uri().path(),
        request.headers(),
        peer,
    ) {
        Ok(()) => next.run(request).await,
        Err(refusal) => {
            let path = request.uri().path();
            match refusal.status {
                // A browser sends its first request without a token.
                StatusCode::UNAUTHORIZED
                    if !request.headers().contains_key(header::AUTHORIZATION) =>
                {
                    tracing::info!(%peer, path, "a token is needed");
                }
                _ => tracing::warn!(%peer, path, "refused: {}", refusal.message),
            }
            if refusal.status == StatusCode::TOO_MANY_REQUESTS {
                tokio::time::sleep(LATE).await;
            }
            refusal.into_response()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        let pairs = pairs
            .iter()
            .map(|(name, value)| (HeaderName::from_static(name), value.parse().unwrap()));
        pairs.collect()
    }

    #[test]
    fn hosts_are_addresses_and_names_that_were_given() {
        let guard = RequestGuard::new(
            "127.0.0.1:1".parse().unwrap(),
            None,
            &["Lab.example".to_owned()],
        );
        let guard = guard.unwrap();
        for good in [
            "localhost",
            "127.0.0.1:8787",
            "[::1]:80",
            "lab.example:1",
            "LOCALHOST:9",
        ] {
            assert!(guard.is_host(good), "{good}");
        }
        for bad in [
            "evil.example",
            "127.0.0.1.evil.example",
            "localhost.evil",
            "",
            "a@localhost",
            "[::1",
        ] {
            assert!(!guard.is_host(bad), "{bad}");
        }
    }

    #[test]
    fn pages_of_other_sites_are_refused() {
        let guard = RequestGuard::new("127.0.0.1:1".parse().unwrap(), None, &[]).unwrap();
        let peer = IpAddr::from([127, 0, 0, 1]);
        let status = |pairs: &[(&'static str, &str)]| {
            let mut all = headers(pairs);
            all.insert(header::HOST, "localhost:1".parse().unwrap());
            guard
                .check(&Method::GET, "/v1/jobs", &all, peer)
                .map_err(|refusal| refusal.status)
        };
        assert_eq!(status(&[]), Ok(()));
        assert_eq!(status(&[("origin", "http://localhost:1")]), Ok(()));
        assert_eq!(status(&[("sec-fetch-site", "same-origin")]), Ok(()));
        for bad in [
            ("origin", "http://localhost:2"),
            ("origin", "http://evil.example"),
            ("origin", "null"),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-site", "same-site"),
        ] {
            assert_eq!(status(&[bad]), Err(StatusCode::FORBIDDEN), "{bad:?}");
        }
        let link = |kind| {
            status(&[
                ("sec-fetch-site", "cross-site"),
                ("sec-fetch-mode", "navigate"),
                ("sec-fetch-dest", kind),
            ])
        };
        assert_eq!(link("document"), Ok(()), "a link opens a page");
        assert_eq!(link("iframe"), Err(StatusCode::FORBIDDEN));
    }

    #[test]
    fn wrong_tokens_are_limited_by_address_and_in_total_and_the_right_one_is_not() {
        let token = "0123456789abcdef0123456789abcdef";
        let guard = RequestGuard::new("0.0.0.0:1".parse().unwrap(), Some(token), &[]).unwrap();
        let [one, other] = [1, 2].map(|last| IpAddr::from([10, 0, 0, last]));
        let status = |token: &str, peer| {
            let bearer = format!("Bearer {token}");
            let all = headers(&[("host", "10.0.0.9"), ("authorization", &bearer)]);
            guard
                .check(&Method::GET, "/v1/jobs", &all, peer)
                .map_err(|refusal| refusal.status)
        };
        assert_eq!(status(token, one), Ok(()));
        for (header, given) in [
            (format!("Bearer {token}"), Some(token)),
            (
                format!("Basic {}", BASE64_STANDARD.encode(format!("me:{token}"))),
                Some(token),
            ),
            (format!("Basic {}", BASE64_STANDARD.encode(token)), None),
            ("Basic ?".to_owned(), None),
            (token.to_owned(), None),
        ] {
            assert_eq!(token_in(&header).as_deref(), given, "{header}");
        }
        for i in 0..WRONG_TOKENS {
            assert_eq!(
                status(&format!("guess{i}"), one),
                Err(StatusCode::UNAUTHORIZED)
            );
        }
        assert_eq!(status("guess", one), Err(StatusCode::TOO_MANY_REQUESTS));
        assert_eq!(
            status(token, one),
            Ok(()),
            "the client at this address has the token"
        );
        assert_eq!(status(token, other), Ok(()));
        let addresses = (3..).map(|last| IpAddr::from([10, 0, 0, last]));
        for address in addresses.take((WRONG_TOKENS_OF_ALL - WRONG_TOKENS) as usize) {
            assert_eq!(status("guess", address), Err(StatusCode::UNAUTHORIZED));
        }
        assert_eq!(status("guess", other), Err(StatusCode::TOO_MANY_REQUESTS));
        assert_eq!(status(token, other), Ok(()));
    }

    #[test]
    fn a_token_is_needed_beyond_loopback_and_is_long() {
        let guard = |listen: &str, token| RequestGuard::new(listen.parse().unwrap(), token, &[]);
        assert!(guard("127.0.0.1:1", None).is_ok() && guard("[::1]:1", None).is_ok());
        for (listen, token) in [
            ("0.0.0.0:1", None),
            ("192.168.0.1:1", None),
            ("[::]:1", None),
            ("127.0.0.1:1", Some("short")),
        ] {
            assert_eq!(
                guard(listen, token).err().map(|e| e.exit_code()),
                Some(64),
                "{listen}"
            );
        }
    }
}
