//! The files of the page, which are part of the program.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};

use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};

/// A file of the page.
#[derive(Debug)]
pub(super) struct Asset {
    /// Its path in URLs.
    pub(super) path: &'static str,
    media_type: &'static str,
    content: &'static str,
}

macro_rules! assets {
    ($($path:literal $media_type:literal $file:literal;)*) => {
        /// All files of the page.
        pub(super) static ASSETS: &[Asset] =
            &[$(Asset { path: $path, media_type: $media_type, content: include_str!(concat!("page/", $file)) },)*];
    };
}

assets! {
    "/"            "text/html; charset=utf-8"       "index.html";
    "/style.css"   "text/css; charset=utf-8"        "style.css";
    "/icon.svg"    "image/svg+xml"                  "icon.svg";
    "/app.js"      "text/javascript; charset=utf-8" "app.js";
    "/model.js"    "text/javascript; charset=utf-8" "model.js";
    "/stream.js"   "text/javascript; charset=utf-8" "stream.js";
    "/format.js"   "text/javascript; charset=utf-8" "format.js";
    "/spark.js"    "text/javascript; charset=utf-8" "spark.js";
    "/plcs.js"     "text/javascript; charset=utf-8" "plcs.js";
    "/aside.js"    "text/javascript; charset=utf-8" "aside.js";
    "/detail.js"   "text/javascript; charset=utf-8" "detail.js";
}

/// Answers with a file, or that the browser has it already.
pub(super) async fn answer(asset: &'static Asset, headers: HeaderMap) -> Response {
    let tag = tag(asset.content);
    let caching = [(header::CACHE_CONTROL, HeaderValue::from_static("no-cache")), (header::ETAG, tag.clone())];
    if headers.get(header::IF_NONE_MATCH) == Some(&tag) {
        return (StatusCode::NOT_MODIFIED, caching).into_response();
    }
    (caching, [(header::CONTENT_TYPE, asset.media_type)], asset.content).into_response()
}

/// The entity tag of a content: another version of the program has another one.
fn tag(content: &str) -> HeaderValue {
    let mut hasher = DefaultHasher::new();
    content.hash(&mut hasher);
    // Of hexadecimal digits and quotes, which a header can have.
    HeaderValue::try_from(format!("\"{:016x}\"", hasher.finish())).unwrap_or(HeaderValue::from_static("\"\""))
}
