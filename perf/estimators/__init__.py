"""The experiments of chapter 2: estimators, local scale, discontinuities, filters, edges and error bars."""
