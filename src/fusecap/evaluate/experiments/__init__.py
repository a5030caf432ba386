"""The paper's experiments of section 4 on the simulated twin; one file per experiment."""
