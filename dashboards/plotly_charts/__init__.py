"""Interactive charts by Plotly."""
