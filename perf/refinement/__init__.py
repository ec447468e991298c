"""The exact refinement measured: accuracy, error bars, growth and cost, beside the affine start that it refines."""
