"""The platform: LLVM and variants, devices, memory, threads, signals and files."""
