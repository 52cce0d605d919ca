//! Checks before each request, and headers after it.

use std::net::IpAddr;

use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};

/// Settings of the checks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Guard {
    /// The listener has a loopback address.
    pub(super) is_loopback: bool,
}

/// The policy of the page: its own files alone, and no text that becomes code or markup.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'; \
                      require-trusted-types-for 'script'; trusted-types 'none'";

/// The headers of each answer.
static HEADERS: [(HeaderName, &str); 6] = [
    (header::CONTENT_SECURITY_POLICY, POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

/// Refuses requests that break a rule, and adds the headers to all answers.
pub(super) async fn check(State(guard): State<Guard>, request: Request, next: Next) -> Response {
    let mut response = if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let allow = [(header::ALLOW, "GET, HEAD")];
        (StatusCode::METHOD_NOT_ALLOWED, allow, "nothing can be written over HTTP\n").into_response()
    } else if guard.is_loopback && !is_for_loopback(request.uri(), request.headers()) {
        let why = "this address answers only to localhost and loopback addresses in the header Host\n";
        (StatusCode::MISDIRECTED_REQUEST, why).into_response()
    } else {
        next.run(request).await
    };
    let headers = response.headers_mut();
    for (name, value) in &HEADERS {
        headers.insert(name.clone(), HeaderValue::from_static(value));
    }
    // The files of the page set their own.
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    response
}

/// Returns whether the host of a request is a loopback address. A request without one is of no browser.
fn is_for_loopback(uri: &Uri, headers: &HeaderMap) -> bool {
    let of_headers = headers.get_all(header::HOST).iter().map(|host| host.to_str().unwrap_or_default());
    of_headers.chain(uri.authority().map(axum::http::uri::Authority::as_str)).all(is_loopback_host)
}

/// Returns whether a host, with or without a port, is a loopback address or a name that always means one.
fn is_loopback_host(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split_once(']').map_or("", |(address, _)| address),
        None => host.split_once(':').map_or(host, |(name, _)| name),
    };
    let name = name.strip_suffix('.').unwrap_or(name).to_ascii_lowercase();
    let is_address = name.parse().is_ok_and(|address: IpAddr| address.to_canonical().is_loopback());
    is_address || name == "localhost" || name.ends_with(".localhost")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_always_mean_loopback_pass() {
        for host in [
            "localhost",
            "LOCALHOST:9187",
            "localhost.",
            "plant.localhost:80",
            "127.0.0.1",
            "127.0.0.1:9187",
            "127.9.9.9:1",
            "[::1]",
            "[::1]:9187",
            "[::ffff:127.0.0.1]:9187",
        ] {
            assert!(is_loopback_host(host), "{host}");
        }
        for host in [
            "",
            "evil.example",
            "evil.example:9187",
            "localhost.evil.example",
            "notlocalhost",
            "127.0.0.1.evil.example",
            "0.0.0.0:9187",
            "192.168.2.3:9187",
            "[::]:9187",
            "[::1",
            "[fe80::1]",
            "evil.example:localhost",
            "localhost@evil.example",
        ] {
            assert!(!is_loopback_host(host), "{host}");
        }
    }

    #[test]
    fn all_hosts_of_a_request_are_checked() {
        let headers = |hosts: &[&'static str]| {
            let hosts = hosts.iter().map(|host| (header::HOST, HeaderValue::from_static(host)));
            hosts.collect::<HeaderMap>()
        };
        let (path, absolute) = (Uri::from_static("/"), Uri::from_static("http://evil.example/"));
        assert!(is_for_loopback(&path, &headers(&["localhost"])));
        assert!(is_for_loopback(&path, &headers(&[])));
        assert!(!is_for_loopback(&path, &headers(&["evil.example"])));
        assert!(!is_for_loopback(&absolute, &headers(&["localhost"])));
    }
}
