# make demo: scan the example part and say which pictures and report to open.
# make test: run every test. Both first install what the machine lacks.
# rustup's cargo is found even by a shell that has not read its profile.
export PATH := $(PATH):$(or $(CARGO_HOME),$(HOME)/.cargo)/bin

.PHONY: demo test setup

demo: setup
	cargo run --release -- scan scenes/bracket/scene.toml -o out/demo

test: setup
	cargo test

setup:
	@sh ffi/setup.sh
