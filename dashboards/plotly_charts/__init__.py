"""Interactive charts of the HTML report, drawn by Plotly."""
