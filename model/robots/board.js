for (const head of document.querySelectorAll("th")) head.onclick = () => {
  const rows = [...head.closest("table").tBodies[0].rows], n = head.cellIndex;
  const value = (row) => row.cells[n].textContent;
  rows.sort((a, b) =>
    parseFloat(value(b)) - parseFloat(value(a)) || value(a).localeCompare(value(b)));
  rows.forEach((row) => row.parentElement.append(row));
};
