"""The inverse problem: scene, variables and views, checked before the first iteration."""
