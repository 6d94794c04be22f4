fn main() -> std::process::ExitCode {
    lasertrace::cli::run().into()
}
