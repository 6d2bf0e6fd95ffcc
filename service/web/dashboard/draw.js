// Drawings: a finger's imprint with marker arrows and slip residual, and the error plane.

export function drawFinger(canvas, image, content) {
  const pen = canvas.getContext("2d");
  const scale = canvas.width / content.width;
  pen.drawImage(image, 0, 0, canvas.width, canvas.height);
  const { rest, moved, residual, valid } = content;
  for (let i = 0; i < valid.length; i += 1) {
    if (!valid[i]) continue;
    const x = rest[2 * i] * scale, y = rest[2 * i + 1] * scale;
    line(pen, x, y, x + 4 * moved[2 * i] * scale, y + 4 * moved[2 * i + 1] * scale, "#ffe14d", 2);
    if (content.slipping[i]) line(pen, x, y, x + 4 * residual[2 * i] * scale, y + 4 * residual[2 * i + 1] * scale, "#ff4d4d", 4);
  }
}

function line(pen, x0, y0, x1, y1, colour, width) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
  pen.stroke();
  pen.fillStyle = colour;
  pen.beginPath();
  pen.arc(x1, y1, width, 0, 7);
  pen.fill();
}

const RANGE = 20;

export function drawPlane(canvas, state) {
  const pen = canvas.getContext("2d");
  const { width, height } = canvas;
  const px = (x) => ((x + RANGE) / (2 * RANGE)) * width;
  const py = (theta) => height - ((theta + RANGE) / (2 * RANGE)) * height;
  pen.fillStyle = "#0b0f14";
  pen.fillRect(0, 0, width, height);
  if (state.belief) shade(pen, state.belief, px, py);
  pen.strokeStyle = "#33404f";
  pen.fillStyle = "#a9b6c4";
  pen.lineWidth = 1;
  pen.font = "26px system-ui";
  for (let v = -10; v <= 10; v += 10) {
    line1(pen, px(v), 0, px(v), height);
    line1(pen, 0, py(v), width, py(v));
    pen.fillText(`${v}`, px(v) + 4, height - 8);
    if (v) pen.fillText(`${v}`, 6, py(v) - 6);
  }
  pen.fillText("x, mm", width - 84, height - 40);
  pen.fillText("yaw, deg", 8, 30);
  pen.strokeStyle = "#57d18b";
  pen.lineWidth = 4;
  line1(pen, px(-1), py(0), px(1), py(0));
  line1(pen, px(0), py(-1), px(0), py(1));
  for (const a of state.attempts) {
    pen.strokeStyle = "#6cb6ff";
    pen.lineWidth = 3;
    pen.beginPath();
    pen.ellipse(px(a.x), py(a.theta), ((a.sx ?? 0.5) / (2 * RANGE)) * width, ((a.st ?? 0.5) / (2 * RANGE)) * height, 0, 0, 7);
    pen.stroke();
    pen.fillStyle = "#f2f5f8";
    pen.font = "bold 28px system-ui";
    pen.fillText(`${a.number}`, px(a.x) - 8, py(a.theta) + 10);
  }
}

function line1(pen, x0, y0, x1, y1) {
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
  pen.stroke();
}

function shade(pen, belief, px, py) {
  const { x_mm: xs, theta_deg: thetas, probability } = belief;
  const most = Math.max(...probability.flat());
  const w = Math.abs(px(xs[1]) - px(xs[0])) + 1, h = Math.abs(py(thetas[1]) - py(thetas[0])) + 1;
  for (let i = 0; i < xs.length; i += 1) {
    for (let j = 0; j < thetas.length; j += 1) {
      const share = probability[i][j] / most;
      if (share < 0.01) continue;
      pen.fillStyle = `rgba(255, 198, 92, ${Math.sqrt(share)})`;
      pen.fillRect(px(xs[i]) - w / 2, py(thetas[j]) - h / 2, w, h);
    }
  }
}
