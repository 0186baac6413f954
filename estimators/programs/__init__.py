"""Programs of any language as estimators."""
