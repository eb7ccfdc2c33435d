"""asv benchmarks of whole calls: size x backend x method. See CONTRIBUTING.md, "Benchmarks over time"."""
