//! Names the shared library by the first two numbers of its version: a program that was
//! linked with it is started with no other.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let [major, minor] = ["MAJOR", "MINOR"]
        .map(|part| std::env::var(format!("CARGO_PKG_VERSION_{part}")).expect("cargo sets it"));
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,liblasertrace.so.{major}.{minor}");
}
