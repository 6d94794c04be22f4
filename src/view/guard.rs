//! Who may ask: pages of this very address, on this machine.

use axum::extract::Request;
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::net::IpAddr;

/// Refuses what did not come from the page itself. A name that was made to stand for this machine (DNS rebinding) is
/// in `Host`; a page of another origin is in `Origin` and `Sec-Fetch-Site`.
pub async fn own_pages(request: Request, next: Next) -> Response {
    match refusal(request.headers()) {
        None => next.run(request).await,
        Some(why) => (StatusCode::FORBIDDEN, why).into_response(),
    }
}

fn refusal(headers: &HeaderMap) -> Option<&'static str> {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    let Some(host) = text(header::HOST).filter(|host| is_this_machine(host)) else {
        return Some("this address answers to localhost, 127.0.0.1 and [::1] alone\n");
    };
    let foreign = "only pages of this address may ask\n";
    let same = |origin: &str| origin.strip_prefix("http://") == Some(host);
    // Typed addresses and links from elsewhere open the page, which is no secret and changes nothing.
    let site = headers.get("sec-fetch-site").map(|value| value.as_bytes());
    let opened = headers.get("sec-fetch-mode").map(|value| value.as_bytes()) == Some(b"navigate");
    let own = matches!(site, None | Some(b"same-origin" | b"none")) || opened;
    match headers.get(header::ORIGIN) {
        Some(_) if !text(header::ORIGIN).is_some_and(same) => Some(foreign),
        _ if !own => Some(foreign),
        _ => None,
    }
}

/// Of a `Host` header, with or without a port.
fn is_this_machine(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    };
    let address = name
        .strip_prefix('[')
        .and_then(|name| name.strip_suffix(']'));
    let address = address.unwrap_or(name).parse::<IpAddr>();
    name.eq_ignore_ascii_case("localhost") || address.is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_this_machine_are_its_own() {
        for host in [
            "localhost",
            "LOCALHOST:80",
            "127.0.0.1:8788",
            "127.1.2.3",
            "[::1]:9",
            "[::1]",
        ] {
            assert!(is_this_machine(host), "{host}");
        }
        for host in [
            "",
            "evil.example",
            "localhost.evil.example:80",
            "127.0.0.1.evil.example",
            "10.0.0.1:80",
            "0.0.0.0",
            "[::2]",
            "localhost:80:80",
            "[::ffff:10.0.0.1]",
        ] {
            assert!(!is_this_machine(host), "{host}");
        }
    }

    #[test]
    fn pages_of_other_origins_are_refused() {
        let headers = |pairs: &[(&'static str, &'static str)]| -> HeaderMap {
            let pair = |&(name, value): &(&'static str, &'static str)| {
                (
                    name.parse::<header::HeaderName>().unwrap(),
                    value.parse().unwrap(),
                )
            };
            pairs.iter().map(pair).collect()
        };
        let host = ("host", "127.0.0.1:5");
        let taken = [
            vec![host],
            vec![
                host,
                ("sec-fetch-site", "same-origin"),
                ("origin", "http://127.0.0.1:5"),
            ],
            vec![
                host,
                ("sec-fetch-site", "cross-site"),
                ("sec-fetch-mode", "navigate"),
            ],
        ];
        for pairs in taken {
            assert_eq!(refusal(&headers(&pairs)), None, "{pairs:?}");
        }
        let refused = [
            vec![],
            vec![("host", "evil.example")],
            vec![host, ("origin", "http://evil.example")],
            vec![host, ("origin", "null")],
            vec![host, ("origin", "http://127.0.0.1:6")],
            vec![
                host,
                ("sec-fetch-site", "cross-site"),
                ("sec-fetch-mode", "no-cors"),
            ],
            vec![host, ("sec-fetch-site", "same-site")],
        ];
        for pairs in refused {
            assert!(refusal(&headers(&pairs)).is_some(), "{pairs:?}");
        }
    }
}
