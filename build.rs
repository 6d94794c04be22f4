//! Compiles the shim for the installed Embree and generates Rust bindings from the shim's header.
//! Struct layouts therefore match the linked library.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    #[cfg(feature = "embree")]
    embree::build();
}

#[cfg(feature = "embree")]
mod embree {
    use std::path::PathBuf;

    /// Fails the build with a message that states the remedy.
    fn fail(sentence: &str) -> ! {
        println!("cargo::error={sentence}");
        std::process::exit(1);
    }

    const INSTALL_EMBREE: &str = "Embree 3.13 or newer with its C headers is needed: on Debian run `apt-get install libembree-dev`";

    pub fn build() {
        for file in ["ffi/embree.h", "ffi/embree.c"] {
            println!("cargo::rerun-if-changed={file}");
        }
        let mut shim = cc::Build::new();
        shim.file("ffi/embree.c").std("c11");

        let expanded = cc::Build::new()
            .file("ffi/embree.c")
            .cargo_warnings(false)
            .cargo_metadata(false)
            .try_expand();
        let source = match expanded {
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
            Err(error) if format!("{error}").contains("find tool") => {
                fail("a C compiler is needed: on Debian run `apt-get install gcc libc6-dev`")
            }
            Err(_) => fail(INSTALL_EMBREE),
        };
        // The line markers of the preprocessor contain the name of the header.
        let library = if source.contains("embree4/rtcore") {
            "embree4"
        } else {
            "embree3"
        };
        shim.compile("lasertrace_embree");
        println!("cargo::rustc-link-lib=dylib={library}");

        // bindgen panics without libclang; the message below is clearer.
        std::panic::set_hook(Box::new(|_| ()));
        let bindings = std::panic::catch_unwind(|| {
            bindgen::Builder::default()
                .header("ffi/embree.h")
                .allowlist_function("lt_.*")
                .allowlist_type("RTCRayHit16|RTCRay16|RTCPointQuery.*|RTCError")
                .allowlist_var("LT_NO_GEOMETRY")
                .prepend_enum_name(false)
                .generate()
        });
        let _ = std::panic::take_hook();
        let Ok(Ok(bindings)) = bindings else {
            fail(
                "libclang is needed to read Embree's headers: on Debian run `apt-get install libclang-dev`",
            );
        };
        let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
        bindings
            .write_to_file(out.join("embree.rs"))
            .expect("OUT_DIR is writable");
    }
}
