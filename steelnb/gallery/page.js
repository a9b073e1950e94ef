// Draws each figure whose data follows its place. A 3D box without perspective keeps its size where the page is narrow,
// so it is made smaller there.
for (const place of document.querySelectorAll(".plot")) {
  const { data, layout, config } = JSON.parse(place.nextElementSibling.textContent);
  const scale = Math.min(1, place.clientWidth / 620);
  for (const side of ["x", "y", "z"]) {
    if (layout.scene?.aspectratio) layout.scene.aspectratio[side] *= scale;
  }
  Plotly.newPlot(place, data, layout, { ...config, responsive: true });
}
