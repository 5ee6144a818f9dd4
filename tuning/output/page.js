const charts = JSON.parse(document.getElementById("charts").textContent);
// nothing leaves the page: no button that uploads a chart, no address to upload it to
const config = {
  responsive: true,
  displaylogo: false,
  showSendToCloud: false,
  plotlyServerURL: "",
  modeBarButtonsToRemove: ["lasso2d", "select2d", "sendChartToCloud", "sendDataToCloud"],
};
for (const [name, chart] of Object.entries(charts)) {
  const made = Plotly.newPlot(name, { data: chart.data, layout: chart.layout, frames: chart.frames || [], config });
  made.catch((error) => console.error(name, error));
}
