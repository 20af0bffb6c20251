// Actions, gripper, speeds and distances over time: drawn once an episode, with the cursor and the marks on top.

const COLOURS = ["#58a6ff", "#f778ba", "#7ee787", "#ffa657", "#d2a8ff", "#79c0ff", "#ff7b72", "#e3b341"];
const EEF = "#f4f7fa";
const LEFT = 74;

export class Plots {
  // canvas: to draw on. keys: an element over it, for the names of the lines. seek(step): a click goes there.
  constructor(canvas, keys, seek) {
    Object.assign(this, { canvas, keys, base: document.createElement("canvas"), episode: null, marks: {} });
    const go = (event) => {
      if (this.episode && event.buttons === 1) seek(this.#step(event.offsetX));
    };
    canvas.addEventListener("pointerdown", go);
    canvas.addEventListener("pointermove", go);
    new ResizeObserver(() => this.#redraw()).observe(canvas);
  }

  // episode: as the server describes it.
  show(episode) {
    this.episode = episode;
    this.#redraw();
  }

  colour(name) {
    return COLOURS[this.#objects().indexOf(name) % COLOURS.length];
  }

  #objects() {
    return [...new Set([...Object.keys(this.episode.object_speed), ...Object.keys(this.episode.places)])];
  }

  // marks: {step, point, suggestions: [step]}.
  at(marks) {
    this.marks = marks;
    const { canvas } = this;
    const draw = canvas.getContext("2d");
    draw.setTransform(1, 0, 0, 1, 0, 0);
    draw.clearRect(0, 0, canvas.width, canvas.height);
    if (!this.episode || !canvas.width) return;
    draw.drawImage(this.base, 0, 0);
    draw.scale(this.scale, this.scale);
    const height = canvas.height / this.scale;
    const line = (step, colour, width, dash) => {
      draw.strokeStyle = colour;
      draw.lineWidth = width;
      draw.setLineDash(dash);
      draw.beginPath();
      draw.moveTo(this.#x(step), 0);
      draw.lineTo(this.#x(step), height);
      draw.stroke();
    };
    for (const step of marks.suggestions || []) line(step, "#56d4dd", 2, [4, 4]);
    if (marks.point !== null && marks.point !== undefined) {
      line(marks.point, "#ffb020", 3, []);
      draw.fillStyle = "#ffb020";
      draw.fillRect(this.#x(marks.point) - 8, 0, 16, 15);
      draw.fillStyle = "#000";
      draw.font = "bold 12px sans-serif";
      draw.fillText("R", this.#x(marks.point) - 4, 12);
    }
    line(marks.step, "#ffffff", 1.5, []);
  }

  #x(step) {
    const width = this.canvas.width / this.scale - LEFT - 10;
    return LEFT + (step / Math.max(this.episode.steps - 1, 1)) * width;
  }

  #step(x) {
    const width = this.canvas.width / this.scale - LEFT - 10;
    const step = Math.round(((x - LEFT) / width) * (this.episode.steps - 1));
    return Math.min(Math.max(step, 0), this.episode.steps - 1);
  }

  #redraw() {
    const { canvas, base, episode } = this;
    this.scale = devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    for (const c of [canvas, base]) { c.width = width * this.scale; c.height = height * this.scale; }
    if (!episode || !width) return;
    const draw = base.getContext("2d");
    draw.scale(this.scale, this.scale);
    const plain = (lists) => Object.entries(lists).map(([name, values], i) => (
      { name, values, colour: COLOURS[i % COLOURS.length], dash: i < COLOURS.length ? [] : [5, 4] }
    ));
    const own = (lists) => Object.entries(lists).map(([name, values]) => ({ name, values, colour: this.colour(name), dash: [] }));
    const part = (key, dash) => own(Object.fromEntries(
      Object.entries(episode.places).filter(([, p]) => p[key]).map(([name, p]) => [name, p[key]]),
    )).map((line) => ({ ...line, dash }));
    const goals = part("goal", [5, 4]).map((line) => ({ ...line, name: `${line.name} from its goal` }));
    const hand = { name: "hand", values: episode.eef_speed, colour: EEF, dash: [] };
    const rows = [
      { name: "action", lines: plain(episode.actions), weight: 3 },
      { name: "gripper", lines: plain(episode.gripper), weight: 1.4 },
      { name: "speed", unit: "m/s", lines: [...own(episode.object_speed), hand], weight: 3, zero: true },
      {
        name: "distance", unit: "m", weight: 3, zero: true,
        lines: [...part("reach", []), ...goals], title: "from the hand:",
      },
    ].filter((row) => row.lines.length);
    const total = rows.reduce((sum, row) => sum + row.weight, 0);
    let top = 4;
    this.keys.replaceChildren();
    for (const row of rows) {
      const high = ((height - 8) * row.weight) / total;
      this.#names(row, top);
      this.#row(draw, row, top, high - 8);
      top += high;
    }
    this.at(this.marks);
  }

  // Which line is what, over the row's upper edge.
  #names(row, top) {
    const names = this.keys.appendChild(document.createElement("p"));
    names.dataset.row = row.name;
    names.style.setProperty("top", `${top + 1}px`);
    if (row.title) names.append(row.title);
    for (const { name, colour, dash } of row.lines) {
      const item = names.appendChild(document.createElement("span"));
      const line = item.appendChild(document.createElement("i"));
      line.style.setProperty("border-top", `2px ${dash.length ? "dashed" : "solid"} ${colour}`);
      item.append(name);
    }
  }

  #row(draw, row, top, high) {
    const values = row.lines.flatMap((line) => line.values);
    const low = row.zero ? 0 : Math.min(...values, 0);
    const range = Math.max(...values, row.zero ? 0.05 : 0) - low || 1;
    const y = (value) => top + high - ((value - low) / range) * high;
    draw.strokeStyle = "#2b3543";
    draw.lineWidth = 1;
    draw.strokeRect(LEFT, top, this.#x(this.episode.steps - 1) - LEFT, high);
    draw.fillStyle = "#b6c2cf";
    draw.font = "12px sans-serif";
    draw.fillText(row.name, 4, top + 11);
    draw.font = "11px sans-serif";
    if (high >= 26) draw.fillText(`${(low + range).toFixed(2)}${row.unit ? ` ${row.unit}` : ""}`, 4, top + 24, LEFT - 8);
    if (!row.zero) {
      draw.beginPath();
      draw.moveTo(LEFT, y(0));
      draw.lineTo(this.#x(this.episode.steps - 1), y(0));
      draw.stroke();
    }
    draw.lineWidth = 1.6;
    for (const { values: line, colour, dash } of row.lines) {
      draw.strokeStyle = colour;
      draw.setLineDash(dash);
      draw.beginPath();
      line.forEach((value, step) => draw[step ? "lineTo" : "moveTo"](this.#x(step), y(value)));
      draw.stroke();
    }
    draw.setLineDash([]);
  }
}
