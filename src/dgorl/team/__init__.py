"""The live team: measurements travel in signed bundles, every robot computes the same. METHOD §6."""
