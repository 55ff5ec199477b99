"""Layer 3: sensor noise and systematic errors, estimated from a log without ground truth."""
