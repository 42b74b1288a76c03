"""The platform: LLVM, Mitsuba variants, devices, memory, threads, signals and files."""
