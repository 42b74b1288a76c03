"""The machine: LLVM and variants, devices, memory, threads, signals and files."""
