"""The process: signals and its end, threads, terminal, commands for a shell, and operating system."""
